"""Episodes recorded for LeRobot: the format as its own writer makes it, the log's joints, and nothing of the session changed."""

from __future__ import annotations

import json
import sys
import time
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cli import main
from marl_handover.control import recording as recorded_by
from marl_handover.control.hardware_backend import HardwareBackend
from marl_handover.control.lerobot_dataset import QUANTILES, DatasetWriter, numbers_stats, pictures_stats
from marl_handover.control.recording import Pace, own_degrees, task_text
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.urdf import JointSource
from marl_handover.hardware.clock import RealClock, VirtualClock
from marl_handover.perception.calibration import CameraCalibration
from marl_handover.perception.detector import Detector

pq = pytest.importorskip("pyarrow.parquet")
pd = pytest.importorskip("pandas")

VIDEO = "observation.images.top"
SCALARS = {
    "timestamp": "float",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
    "next.done": "bool",
    "next.success": "bool",
}
"""Columns of one number each, by the name of their kind in Arrow."""

ONE = ["start=[-60,20,40]", "goal=[50,25,76]"]
FPS = 10


def pictures(path):
    with imageio.get_reader(path, "ffmpeg") as reader:
        return [np.asarray(frame) for frame in reader]


def check_schema(root, fps, joints):
    """What LeRobot 0.6.2 writes and its loader goes by: info, table, films, tasks, episodes, statistics. The table's columns."""
    info = json.loads((root / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == fps
    features = info["features"]
    for name in ("observation.state", "action"):
        assert features[name] == {"dtype": "float32", "shape": [len(joints)], "names": joints}
    kinds = {name: {"float": "float32"}.get(kind, kind) for name, kind in SCALARS.items()}
    assert {name: features[name] for name in SCALARS} == {
        name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()
    }
    height, width, channels = features[VIDEO]["shape"]
    assert (features[VIDEO]["dtype"], features[VIDEO]["names"], channels) == ("video", ["height", "width", "channels"], 3)

    tables = [pq.read_table(path) for path in sorted((root / "data").glob("*/*.parquet"))]
    assert [(str(field.type), field.name) for field in tables[0].schema if field.name in SCALARS] == [
        (SCALARS[name], name) for name in tables[0].schema.names if name in SCALARS
    ]
    for name in ("observation.state", "action"):
        kind = tables[0].schema.field(name).type
        assert (str(kind.value_type), kind.list_size) == ("float", len(joints))
    assert set(tables[0].schema.names) == {*features} - {VIDEO}
    columns = {name: np.concatenate([np.array(table[name].to_pylist()) for table in tables]) for name in tables[0].schema.names}
    count = info["total_frames"]
    np.testing.assert_array_equal(columns["index"], np.arange(count))
    np.testing.assert_allclose(columns["timestamp"], columns["frame_index"] / fps, rtol=1e-6)
    assert np.isfinite(columns["observation.state"]).all()

    tasks = pd.read_parquet(root / "meta/tasks.parquet")
    assert tasks["task_index"].tolist() == list(range(info["total_tasks"]))
    assert all(isinstance(tasks.iloc[number].name, str) for number in tasks["task_index"])
    episodes = pd.concat([pd.read_parquet(path) for path in sorted((root / "meta/episodes").glob("*/*.parquet"))])
    assert len(episodes) == info["total_episodes"]
    assert info["splits"] == {"train": f"0:{len(episodes)}"}
    begin = 0
    for number, row in enumerate(episodes.to_dict("records")):
        here = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert (row["episode_index"], here.start, here.stop - here.start) == (number, begin, row["length"])
        begin = here.stop
        assert (columns["episode_index"][here] == number).all()
        np.testing.assert_array_equal(columns["frame_index"][here], np.arange(row["length"]))
        assert columns["next.done"][here].tolist() == [False] * (row["length"] - 1) + [True]
        assert [tasks.iloc[task].name for task in dict.fromkeys(columns["task_index"][here])] == list(row["tasks"])
        path = info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        assert number in pq.read_table(root / path)["episode_index"].to_pylist()
        at = f"videos/{VIDEO}"
        film = info["video_path"].format(video_key=VIDEO, chunk_index=row[f"{at}/chunk_index"], file_index=row[f"{at}/file_index"])
        assert row[f"{at}/to_timestamp"] - row[f"{at}/from_timestamp"] == pytest.approx(row["length"] / fps)
        shown = pictures(root / film)
        assert len(shown) == row["length"]
        assert shown[0].shape == (height, width, 3)
        for name, values in columns.items():
            np.testing.assert_allclose(np.hstack(row[f"stats/{name}/mean"]), np.atleast_1d(values[here].mean(0)), rtol=1e-5, atol=1e-5)
    assert begin == count

    stats = json.loads((root / "meta/stats.json").read_text())
    assert set(stats) == set(features)
    for name, each in stats.items():
        assert set(each) == {"min", "max", "mean", "std", "count", *QUANTILES}
        shape = (3, 1, 1) if name == VIDEO else tuple(features[name]["shape"])
        assert {np.shape(value) for key, value in each.items() if key != "count"} == {shape}
        assert each["count"] == [count]
    assert 0 <= np.min(stats[VIDEO]["min"]) <= np.max(stats[VIDEO]["max"]) <= 1
    return columns


@pytest.fixture(scope="module")
def session(twin_calibration, tmp_path_factory):
    """Two episodes of the twin, recorded and logged; and the log of the same without the recording."""
    folder, rows = tmp_path_factory.mktemp("recorded"), {}
    usual = [f"calibration={twin_calibration}", f"hardware.stop_file={folder / 'stop'}", "policy=exact", "episodes=2", "seed=3"]
    for name, more in (("log", [f"record={folder / 'data'}", f"record_fps={FPS}"]), ("plain", [])):
        assert main(["run", "hardware=twin", f"log={folder / name}", *usual, *more]) == 0
        rows[name] = [json.loads(line) for line in (folder / name).read_text().splitlines()]
    return SimpleNamespace(root=folder / "data", calibration=twin_calibration, **rows)


@pytest.fixture(scope="module")
def columns(session):
    joints = ["base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll", "gripper"]
    return check_schema(session.root, FPS, [f"{arm}_{joint}.pos" for arm in ("left", "right") for joint in joints])


def test_the_dataset_is_as_lerobot_writes_it(columns):
    assert columns["next.success"].sum() == 2
    np.testing.assert_array_equal(columns["next.success"], columns["next.done"])


def test_nothing_is_left_beside_the_dataset(session):
    assert {path.name for path in session.root.parent.iterdir()} <= {"data", "log", "plain", "stop"}


def test_recording_changes_nothing_of_the_session(session):
    def without_computing_time(rows):
        return [{name: value for name, value in row.items() if name != "planning_ms"} for row in rows]

    assert without_computing_time(session.log) == without_computing_time(session.plain)


def test_frames_and_joints_are_those_of_the_log(session, columns):
    """Between two lines of the log an arm is on a straight way from where it was sent to where it is sent then."""
    episodes = []
    for row in session.log:
        if row["event"] == "episode":
            episodes.append([])
        if episodes:
            episodes[-1].append(row)
    for number, rows in enumerate(episodes):
        here = columns["episode_index"] == number
        begin_s, end_s = (next(row["t_s"] for row in rows if row["event"] == event) for event in ("goal", "ended"))
        assert abs((end_s - begin_s) * FPS + 0.5 - here.sum()) <= 0.5 + 1e-2
        told = [row for row in rows if row["event"] == "state"]
        t_s = np.array([row["t_s"] for row in told])
        logged = [np.column_stack([np.degrees(row["joints_rad"]), np.array(row["gripper_mm"]) / 12.0 * 100]).ravel() for row in told]
        at_s = begin_s + columns["timestamp"][here]
        inside = (at_s >= t_s[0]) & (at_s <= t_s[-1])
        assert inside.sum() > 50
        wanted = np.column_stack([np.interp(at_s[inside], t_s, column) for column in np.array(logged).T])
        away = np.abs(columns["observation.state"][here][inside] - wanted)
        fastest = np.abs(np.diff(logged, axis=0)).max(axis=0)
        assert (away <= 0.02 + 0.5 * fastest).all()
        assert np.median(away) < 0.02


def test_an_action_is_where_the_arms_are_sent_for_the_next_frame(columns):
    for number in (0, 1):
        here = columns["episode_index"] == number
        states, actions = columns["observation.state"][here], columns["action"][here]
        np.testing.assert_array_equal(actions[:-1], states[1:])
        np.testing.assert_array_equal(actions[-1], states[-1])


def test_the_last_picture_shows_the_block_at_the_goal(session, model):
    detector = Detector(CameraCalibration.load(session.calibration / "camera.json"), model.cell.config.block)
    goals = [row["goal"] for row in session.log if row["event"] == "ended"]
    texts = pd.read_parquet(session.root / "meta/tasks.parquet").index.tolist()
    assert texts == [task_text(np.array(goal)) for goal in goals]
    for number, goal in enumerate(goals):
        last = pictures(session.root / f"videos/{VIDEO}/chunk-000/file-{number:03d}.mp4")[-1]
        found = detector.detect(np.ascontiguousarray(last[..., ::-1]))
        assert found.block is not None
        assert np.hypot(*(found.block.pose[:2] - goal[:2])) < 6.0


def test_evaluate_records_the_twin(twin_calibration, tmp_path, capsys):
    arguments = ["policy=exact", "backend=twin", "episodes=1", "seed=1", "progress=false", f"calibration={twin_calibration}"]
    assert main(["evaluate", *arguments, f"record={tmp_path / 'data'}", "record_fps=5"]) == 0
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"], info["robot_type"]) == (5, 1, "twin")
    assert f"recorded 1 episode, {info['total_frames']} frames at 5 a second: {tmp_path / 'data'}" in capsys.readouterr().out


@pytest.mark.parametrize("whole", [0, 1])
def test_ctrl_c_leaves_whole_episodes_only(twin_calibration, tmp_path, monkeypatch, whole, caplog):
    usual = [f"calibration={twin_calibration}", f"hardware.stop_file={tmp_path / 'stop'}", "policy=exact"]
    execute, ended = HardwareBackend.execute, []

    def interrupted(backend, arm, paths):
        if len(ended) == whole and backend.true_pose() is not None:
            backend.workcell.clock.sleep_s(1.0)  # frames of the episode that is broken off
            raise KeyboardInterrupt
        return execute(backend, arm, paths)

    monkeypatch.setattr(HardwareBackend, "execute", interrupted)
    monkeypatch.setattr("marl_handover.commands.run._tell", lambda *given: ended.append(given))
    assert main(["run", "hardware=twin", "episodes=3", f"record={tmp_path / 'data'}", *usual, *ONE]) not in (0, 2)
    assert {path.name for path in tmp_path.iterdir()} - {"stop"} == ({"data"} if whole else set())
    assert "an episode that was broken off is left out" in caplog.text
    if whole:
        info = json.loads((tmp_path / "data/meta/info.json").read_text())
        assert info["total_episodes"] == 1
        assert len(list((tmp_path / "data").rglob("*.mp4"))) == 1
        assert pq.read_table(tmp_path / "data/data/chunk-000/file-000.parquet").num_rows == info["total_frames"]


@pytest.mark.parametrize(
    ("command", "word"),
    [
        (["run", "hardware=twin", "record={there}"], "must be a folder that is not there yet"),
        (["run", "hardware=twin", "record=/nowhere/data"], "folder not found: /nowhere"),
        (["run", "hardware=twin", "record={new}", "dry_run=true"], "in which no arm moves"),
        (["run", "hardware=twin", "record={new}", "record_fps=0"], "record_fps"),
        (["evaluate", "policy=exact", "record={new}"], "backend=twin"),
        (["evaluate", "policy=exact", "backend=noisy", "record={new}"], "backend=twin"),
    ],
)
def test_bad_input_is_one_line(capsys, twin_calibration, tmp_path, command, word):
    (tmp_path / "there").mkdir()
    given = [argument.format(there=tmp_path / "there", new=tmp_path / "new") for argument in command]
    given += [f"calibration={twin_calibration}", f"hardware.stop_file={tmp_path / 'stop'}"] if given[0] == "run" else []
    assert main(given) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert word in error
    assert not (tmp_path / "new").exists()


def test_without_pyarrow_the_line_that_installs_it_is_said(capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert main(["run", "hardware=twin", f"record={tmp_path / 'data'}"]) == 2
    error = capsys.readouterr().err
    assert "record needs the package pyarrow; run: pip install" in error
    assert error.count("\n") == 1


def picture(value):
    return np.full((32, 48, 3), value, np.uint8)


def test_episodes_that_are_dropped_leave_nothing(tmp_path):
    with DatasetWriter(tmp_path / "data", 5, ["a.pos", "b.pos"], "top", "robot") as writer:
        for success, value in ((True, 10), (False, 200)):
            for _ in range(3):
                writer.add_picture(picture(99))
            writer.drop_episode()
            for _ in range(4):
                writer.add_picture(picture(value))
            states = np.arange(8).reshape(4, 2) + value
            writer.save_episode(states, states, ["here", "here", "there", "there"], success)
        writer.add_picture(picture(99))
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    columns = check_schema(tmp_path / "data", 5, ["a.pos", "b.pos"])
    assert columns["task_index"].tolist() == [0, 0, 1, 1] * 2
    assert columns["next.success"].tolist() == [False] * 3 + [True] + [False] * 4
    np.testing.assert_array_equal(columns["observation.state"][4], [200, 201])
    for number, value in enumerate((10, 200)):
        shown = pictures(tmp_path / f"data/videos/{VIDEO}/chunk-000/file-{number:03d}.mp4")
        assert np.abs(np.array(shown, float) - value).max() < 4
    stats = json.loads((tmp_path / "data/meta/stats.json").read_text())
    np.testing.assert_allclose(np.ravel(stats[VIDEO]["mean"]), 105 / 255, atol=1e-9)


def test_a_dataset_without_a_whole_episode_is_none(tmp_path):
    with DatasetWriter(tmp_path / "data", 5, ["a.pos"], "top", "robot") as writer:
        writer.add_picture(picture(0))
    assert not list(tmp_path.iterdir())


def test_a_thousand_episodes_share_a_file_of_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr("marl_handover.control.lerobot_dataset.EPISODES_PER_FILE", 2)
    with DatasetWriter(tmp_path / "data", 5, ["a.pos"], "top", "robot") as writer:
        for number in range(5):
            for _ in range(2):
                writer.add_picture(picture(number))
            writer.save_episode([[number]] * 2, [[number]] * 2, ["go"] * 2, True)
    assert [path.name for path in sorted((tmp_path / "data/data").rglob("*.parquet"))] == [f"file-00{file}.parquet" for file in range(3)]
    assert check_schema(tmp_path / "data", 5, ["a.pos"])["observation.state"].ravel().tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


@given(st.lists(st.integers(0, 255), min_size=3, max_size=60))
def test_statistics_of_pictures_are_those_of_their_pixels(levels):
    values = np.array(levels)
    stats = pictures_stats(np.stack([np.bincount(values, minlength=256)] * 3), 1)
    wanted = {"min": values.min(), "max": values.max(), "mean": values.mean(), "std": values.std()}
    wanted |= {name: np.quantile(values, share, method="inverted_cdf") for name, share in QUANTILES.items()}
    for name, value in wanted.items():
        np.testing.assert_allclose(np.ravel(stats[name]), value / 255, atol=1e-7)


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.booleans()), min_size=1, max_size=30))
def test_statistics_of_numbers_lie_in_order(rows):
    for values in (np.array([row[0] for row in rows]), np.array([row[1] for row in rows])):
        stats = numbers_stats(values)
        assert stats["count"] == [len(rows)]
        ordered = [stats[name][0] for name in ("min", *QUANTILES, "max")]
        assert ordered == sorted(ordered)
        assert stats["min"][0] - 1e-9 <= stats["mean"][0] <= stats["max"][0] + 1e-9


def test_joints_are_counted_as_the_robots_own_file_does():
    sources = (JointSource("pan", -1, np.pi / 2), JointSource("lift"), JointSource(None))
    np.testing.assert_allclose(own_degrees(sources, np.radians([30.0, -20.0, 0.0])), [60.0, -20.0])


def test_frames_are_taken_at_their_times_on_a_virtual_clock():
    clock, taken = VirtualClock(), []
    clock.sleep_s(0.35)
    pace = Pace(clock, 0.1, lambda: taken.append(clock.now_s()))
    for _ in range(11):
        clock.sleep_s(0.05)
    pace.stop()
    clock.sleep_s(1.0)
    np.testing.assert_allclose(taken, 0.35 + 0.1 * np.arange(6))


def test_a_thread_takes_frames_on_a_real_clock_and_makes_up_for_what_it_lost():
    taken = []

    def take():
        taken.append(time.monotonic())
        if len(taken) == 2:
            time.sleep(0.1)

    begun = time.monotonic()
    pace = Pace(RealClock(), 0.02, take)
    time.sleep(0.5)
    pace.stop()
    pace.join()
    assert abs(len(taken) - (time.monotonic() - begun) / 0.02) < 3
    count = len(taken)
    time.sleep(0.05)
    assert len(taken) == count


def frames_of(joints, goal=(50.0, 25.0, 1.0)):
    """What is saved of readings one after the other."""
    saved, readings = [], iter(np.array(joints, float))
    writer = SimpleNamespace(add_picture=lambda shown: None, episodes=0, save_episode=lambda *given: saved.append(given))
    arms = SimpleNamespace(joints=lambda: next(readings), picture=lambda: picture(0))
    frames = recorded_by._Frames(writer, arms, SimpleNamespace(goal=np.array(goal), ended="success"))
    for _ in joints:
        frames.take()
    frames.save()
    return saved


def test_a_limp_arm_has_the_joints_that_were_known_last(caplog):
    [(states, actions, tasks, success)] = frames_of([[np.nan, 0], [1, 2], [np.nan, 3], [4, 5]])
    np.testing.assert_array_equal(states, [[1, 2], [1, 3], [4, 5]])
    np.testing.assert_array_equal(actions, [[1, 3], [4, 5], [4, 5]])
    assert success
    assert len(tasks) == 3
    assert "in 1 of 3 frames of episode 0 an arm was limp" in caplog.text


def test_no_frame_is_taken_before_there_is_a_goal():
    assert not frames_of([[1, 2], [3, 4]], goal=[np.inf] * 3)


def test_what_went_wrong_while_arms_moved_is_said_at_the_end():
    arms = SimpleNamespace(joints=lambda: next(iter(())), picture=lambda: picture(0))
    frames = recorded_by._Frames(SimpleNamespace(), arms, SimpleNamespace(goal=np.zeros(3), ended=None))
    frames.take()
    frames.take()
    with pytest.raises(StopIteration):
        frames.save()


def test_a_folder_that_is_there_is_refused_by_name(tmp_path):
    for name in ("file", "link"):
        (tmp_path / "file").touch()
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(tmp_path / "nowhere")
        with pytest.raises(InvalidSetting, match=f"record = .*{name}.*: must be a folder that is not there yet"):
            DatasetWriter(tmp_path / name, 5, ["a.pos"], "top", "robot")
