"""Episodes in files as LeRobot reads them: LeRobotDataset v3.0, numbers in Parquet, pictures in MP4, and tables about both.

The layout is that of LeRobot's own writer, version 0.6.2. Numbers of a thousand episodes share a file. Every episode has a film of its own,
so that a picture's time in its film is its time in the episode, and an episode that breaks off leaves nothing behind.
"""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Floats
from marl_handover.errors import CannotWrite, InvalidSetting, MissingExtra, MissingFile
from marl_handover.files import temporary_of
from marl_handover.perception.calibration import Pixels
from marl_handover.simulation.video import Video

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FILES_PER_CHUNK = EPISODES_PER_FILE = 1000

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

_LEVELS = np.arange(256) / 255
_THINNED = 8
"""Statistics of pictures are those of every so manieth pixel each way."""


class _Dropped(Exception):
    """Ends a film that nobody wants."""


def pyarrow(setting: str) -> Any:
    """The module pyarrow with its Parquet, which ``setting`` needs. Raises :class:`MissingExtra`."""
    try:
        importlib.import_module("pyarrow.parquet")
        return importlib.import_module("pyarrow")
    except ImportError as error:
        raise MissingExtra(setting, "pyarrow", "record") from error


class DatasetWriter:
    """A context manager that writes a dataset; its folder appears when the block ends, however it ends, with all whole episodes.

    Args:
        folder: of the dataset; must not exist.
        fps: frames a second.
        joints: what the numbers of a state, and of an action, are called.
        camera: what the camera is called.
        robot_type: what the robot is called.
        name: of the setting, for errors.

    Raises:
        MissingExtra: pyarrow is not installed.
        InvalidSetting, MissingFile: the folder is there already, or the one that it is to be in is not.
        CannotWrite: there is no room.
    """

    def __init__(self, folder: Path | str, fps: int, joints: Sequence[str], camera: str, robot_type: str, name: str = "record") -> None:
        self._pa = pyarrow(name)
        self.folder, self.fps, self.robot_type = require_new_folder(name, folder), fps, robot_type
        self._video_key = f"observation.images.{camera}"
        self._joints, self._size = list(joints), (0, 0)
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._numbers: dict[str, list[NDArray[Any]]] = {}
        self._histogram = np.zeros((3, 256), np.int64)
        self._film: Video | None = None
        self._film_histogram, self._pictures = np.zeros_like(self._histogram), 0
        self._table: Any = None
        self.frames = 0
        """Of all whole episodes."""

    @property
    def episodes(self) -> int:
        """How many are whole."""
        return len(self._episodes)

    def __enter__(self) -> Self:
        self._root = temporary_of(self.folder)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.drop_episode()
        try:
            if self._episodes:
                self._finish()
                self._root.rename(self.folder)
        except OSError as failure:
            raise CannotWrite(self.folder, failure) from failure
        finally:
            shutil.rmtree(self._root, ignore_errors=True)

    def add_picture(self, picture: Pixels) -> None:
        """Add a picture, RGB (height, width, 3), to the film of the episode that goes on. Raises :class:`CannotWrite`."""
        try:
            if self._film is None:
                path = self._path(VIDEO_PATH, self.episodes, video_key=self._video_key)
                self._film = Video(path, self.fps, "record", seekable=True).__enter__()
            self._film.add(picture)
        except OSError as failure:
            raise CannotWrite(self.folder, failure) from failure
        self._size = picture.shape[:2]
        self._pictures += 1
        thin = picture[::_THINNED, ::_THINNED].reshape(-1, 3)
        self._film_histogram += np.stack([np.bincount(channel, minlength=256) for channel in thin.T])

    def drop_episode(self) -> None:
        """Forget the pictures that were added since the last whole episode."""
        film, self._film = self._film, None
        self._film_histogram[:], self._pictures = 0, 0
        if film is not None:
            film.__exit__(_Dropped, _Dropped(), None)

    def save_episode(self, states: ArrayLike, actions: ArrayLike, tasks: Sequence[str], success: bool) -> None:
        """End an episode of as many frames as pictures were added.

        Args:
            states: (frames, joints), what was.
            actions: (frames, joints), what was commanded.
            tasks: what was to be done, at each frame.
            success: whether it was done in the end.

        Raises:
            ValueError: there are more or fewer of one than of another.
            CannotWrite: there is no room.
        """
        count, number = self._pictures, self.episodes
        columns = self._columns(np.asarray(states, np.float32), np.asarray(actions, np.float32), tasks, success)
        if self._film is None or any(len(values) != count for values in columns.values()):
            raise ValueError(f"an episode of {count} pictures with {len(tasks)} tasks and states and actions of other lengths")
        film, self._film = self._film, None
        film.__exit__(None, None, None)
        try:
            self._write(columns, number)
        except OSError as failure:
            raise CannotWrite(self.folder, failure) from failure
        stats = {**{name: numbers_stats(values) for name, values in columns.items()}}
        stats[self._video_key] = pictures_stats(self._film_histogram, count)
        chunk, file = divmod(number // EPISODES_PER_FILE, FILES_PER_CHUNK)
        film_chunk, film_file = divmod(number, FILES_PER_CHUNK)
        about = {"episode_index": number, "tasks": list(dict.fromkeys(tasks)), "length": count}
        about |= {"data/chunk_index": chunk, "data/file_index": file}
        about |= {"dataset_from_index": self.frames, "dataset_to_index": self.frames + count}
        at = f"videos/{self._video_key}"
        about |= {f"{at}/chunk_index": film_chunk, f"{at}/file_index": film_file}
        about |= {f"{at}/from_timestamp": 0.0, f"{at}/to_timestamp": count / self.fps}
        about |= {f"stats/{name}/{key}": value for name, each in stats.items() for key, value in each.items()}
        self._episodes.append(about | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        for name, values in columns.items():
            self._numbers.setdefault(name, []).append(values)
        self._histogram += self._film_histogram
        self.frames += count
        self.drop_episode()

    def _columns(self, states: Floats, actions: Floats, tasks: Sequence[str], success: bool) -> dict[str, NDArray[Any]]:
        """The numbers of an episode, by the name of their feature."""
        count = len(tasks)
        frame, last = np.arange(count, dtype=np.int64), np.arange(count) == count - 1
        numbers = [self._tasks.setdefault(task, len(self._tasks)) for task in tasks]
        return {
            "observation.state": states,
            "action": actions,
            "next.done": last,
            "next.success": last & success,
            "timestamp": (frame / self.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(count, self.episodes, np.int64),
            "index": self.frames + frame,
            "task_index": np.array(numbers, np.int64),
        }

    def _write(self, columns: dict[str, NDArray[Any]], number: int) -> None:
        """Append an episode's numbers to the file of its thousand."""
        pa = self._pa
        if number % EPISODES_PER_FILE == 0:
            self._close_table()
        arrays = {
            name: pa.array(values) if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
            for name, values in columns.items()
        }
        table = pa.table(arrays)
        if self._table is None:
            self._table = pa.parquet.ParquetWriter(self._path(DATA_PATH, number // EPISODES_PER_FILE), table.schema)
        self._table.write_table(table)

    def _close_table(self) -> None:
        if self._table is not None:
            self._table.close()
        self._table = None

    def _finish(self) -> None:
        """Write all that is about the episodes."""
        pa = self._pa
        self._close_table()
        pa.parquet.write_table(pa.Table.from_pylist(self._episodes), self._path(EPISODES_PATH, 0))
        pa.parquet.write_table(self._tasks_table(), self._root / "meta/tasks.parquet")
        stats = {name: numbers_stats(np.concatenate(values)) for name, values in self._numbers.items()}
        stats[self._video_key] = pictures_stats(self._histogram, self.frames)
        for name, content in (("stats", stats), ("info", self._info())):
            (self._root / f"meta/{name}.json").write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")

    def _tasks_table(self) -> Any:
        """The tasks and their numbers, the text being what pandas calls the index: LeRobot reads the table with pandas."""
        pa = self._pa
        kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        columns = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None} for name, kind, numpy in kinds
        ]
        about = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
        table = pa.table({"task_index": pa.array(list(self._tasks.values()), pa.int64()), "task": list(self._tasks)})
        return table.replace_schema_metadata({"pandas": json.dumps(about)})

    def _info(self) -> dict[str, Any]:
        """What ``meta/info.json`` says."""
        return {
            "codebase_version": VERSION,
            "fps": self.fps,
            "features": self._features(),
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "robot_type": self.robot_type,
            "splits": {"train": f"0:{self.episodes}"},
        }

    def _features(self) -> dict[str, Any]:
        """What there is of each frame: kind, shape, names."""
        height, width = self._size
        video = {"video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": "yuv420p", "video.fps": self.fps}
        video |= {"video.channels": 3, "has_audio": False, "is_depth_map": False}
        features: dict[str, Any] = {}
        for name, values in self._numbers.items():
            wide = values[0].ndim == 2
            shape = [len(self._joints)] if wide else [1]
            features[name] = {"dtype": str(values[0].dtype), "shape": shape, "names": self._joints if wide else None}
        picture = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": video}
        return {**features, self._video_key: picture}

    def _path(self, template: str, number: int, **names: str) -> Path:
        """The path of a kind's ``number``-th file; its folder is made."""
        chunk, file = divmod(number, FILES_PER_CHUNK)
        path = self._root / template.format(chunk_index=chunk, file_index=file, **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def require_new_folder(name: str, folder: Path | str) -> Path:
    """``folder`` as a :class:`Path`. Raises :class:`InvalidSetting` if it is there, :class:`MissingFile` if the one above it is not."""
    folder = Path(folder)
    if folder.exists() or folder.is_symlink():
        raise InvalidSetting(name, str(folder), "a folder that is not there yet")
    if not folder.parent.is_dir():
        raise MissingFile("folder", folder.parent, "make it first")
    return folder


def numbers_stats(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics of numbers (n,) or (n, k) over their first axis, each of 1 or k; ``count`` is n."""
    rows = values.reshape(len(values), -1).astype(float)
    stats = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    stats |= dict(zip(QUANTILES, np.quantile(rows, list(QUANTILES.values()), axis=0), strict=True))
    return {"count": [len(rows)], **{name: value.tolist() for name, value in stats.items()}}


def pictures_stats(histogram: NDArray[np.int64], count: int) -> dict[str, list[Any]]:
    """Statistics of ``count`` pictures with so many pixels (3, 256) of each level in each channel; each (3, 1, 1), levels from 0 to 1."""
    share = histogram / histogram.sum(axis=1, keepdims=True)
    mean = share @ _LEVELS
    below = np.cumsum(histogram, axis=1)

    def level(share_below: float) -> Floats:
        return _LEVELS[np.argmax(below >= share_below * below[:, -1:], axis=1)]

    seen = histogram > 0
    stats = {"min": _LEVELS[seen.argmax(axis=1)], "max": _LEVELS[255 - seen[:, ::-1].argmax(axis=1)], "mean": mean}
    stats["std"] = np.sqrt(np.maximum(share @ _LEVELS**2 - mean**2, 0.0))
    stats |= {name: level(quantile) for name, quantile in QUANTILES.items()}
    return {"count": [count], **{name: value.reshape(3, 1, 1).tolist() for name, value in stats.items()}}


def names_of(arm: str, joints: Iterable[str | None]) -> list[str]:
    """What LeRobot would call the joints of an arm, None left out, and its gripper: ``left_elbow.pos`` ... ``left_gripper.pos``."""
    return [f"{arm}_{joint}.pos" for joint in (*joints, "gripper") if joint is not None]
