"""Videos: what was written can be read back, and no half file is left."""

import imageio.v2 as imageio
import numpy as np
import pytest

from marl_handover.errors import InvalidSetting, MissingFile
from marl_handover.simulation.video import FrameClock, Video


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_has_its_frames_and_size(tmp_path, suffix):
    with Video(tmp_path / f"a{suffix}", 10) as video:
        for shade in (0, 120, 240):
            video.add(np.full((36, 64, 3), shade, np.uint8))
    frames = [*imageio.get_reader(tmp_path / f"a{suffix}").iter_data()]
    assert [frame.shape[:2] for frame in frames] == [(36, 64)] * 3
    np.testing.assert_allclose([frame[..., 0].mean() for frame in frames], (0, 120, 240), atol=6)
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


def test_an_error_leaves_no_file(tmp_path):
    def fail_half_way():
        with Video(tmp_path / "a.gif", 10) as video:
            video.add(np.zeros((36, 64, 3), np.uint8))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert not list(tmp_path.iterdir())


def test_bad_paths_are_refused(tmp_path):
    with pytest.raises(InvalidSetting, match=r"\.mp4 or \.gif"):
        Video(tmp_path / "a.avi", 10)
    with pytest.raises(MissingFile, match="nowhere"):
        Video(tmp_path / "nowhere" / "a.mp4", 10)


@pytest.mark.parametrize(("fps", "frames"), [(25, 50), (50, 100), (12.5, 25), (30, 60)])
def test_the_clock_gives_the_frames_of_two_seconds(fps, frames):
    clock = FrameClock(fps, 0.02)
    assert sum(clock.due() for _ in range(100)) == frames
