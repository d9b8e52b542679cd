"""Films: poses are those that were walked, and no machine's missing back end ends a run."""

import subprocess

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from model import ROBOT
from PIL import Image
from pretend import instead, pretend_walk
from scipy.spatial.transform import Rotation

from hector_jax import InputError, State
from hector_jax.report import video
from hector_jax.report.motion import motion, motions, poses
from hector_jax.report.video import VideoConfig, VideoUnavailable, write_film, write_strip
from hector_jax.robot.description import MODEL_PATH


def test_a_film_shows_the_pose_of_its_time_as_it_was_walked_and_after_a_fall_the_last_one():
    euler, position = np.array([[0.1, -0.2, 2.5]]), np.array([[0.3, -0.4, 0.5]])
    state = State(euler, position, np.zeros((1, 3)), np.zeros((1, 3)))
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    data = mujoco.MjData(model)
    data.qpos = poses(ROBOT, state, np.asarray(ROBOT.standing_joints)[None])[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.subtree_com[1], position[0], atol=1e-9)
    expected = Rotation.from_euler("ZYX", euler[0, ::-1]).as_matrix()
    np.testing.assert_allclose(data.xmat[1].reshape(3, 3), expected, atol=1e-9)
    slow, fast = (pretend_walk(seconds=1.0, period=p, fall_at=0.5) for p in (0.01, 0.001))
    one, other = motions(ROBOT, {"a": slow, "b": fast}).values()
    times = 0.04 * np.arange(26)
    assert one.sample_at(times)[[0, 10, 25]].tolist() == [0, 39, 99]
    assert other.sample_at(times)[[0, 10, 25]].tolist() == [0, 399, 999]
    trunk = poses(ROBOT, State(*(x[39:40] for x in slow.state)), slow.joints[39:40])
    np.testing.assert_allclose(one.qpos[39], trunk[0])
    assert one.fall_time == pytest.approx(0.5)
    for values in (one.qpos, one.path):
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values[50], values[-1])


@pytest.mark.filterwarnings("ignore:os.fork")  # of the reader used here, not of the writer
def test_films_and_strips_are_written_with_the_promised_size(tmp_path):
    walks = {"nominal": pretend_walk(0, 0.05, 0.2), "with": pretend_walk(1, 0.01, 0.2)}
    walks = motions(ROBOT, walks)
    config = VideoConfig(width=640, height=432, rate=10, tiles=2)
    try:
        write_film(tmp_path / "film.mp4", ROBOT, walks, config)
    except VideoUnavailable as error:
        pytest.skip(str(error))
    frames = imageio_ffmpeg.read_frames(tmp_path / "film.mp4")
    about = next(frames)
    assert (about["size"], about["fps"]) == ((640, 432), 10)
    pictures = [np.frombuffer(f, np.uint8).reshape(432, 640, 3).astype(int) for f in frames]
    assert len(pictures) == 3
    assert np.ptp(pictures[0][60:300]) > 150
    assert np.abs(pictures[2][:320, :320] - pictures[2][:320, 320:]).mean() > 1
    # the plot below is pale where time has not come yet
    first, _, last = (np.sum(np.ptp(picture[324:], axis=-1) > 60) for picture in pictures)
    assert last > first + 20
    write_film(tmp_path / "film.webp", ROBOT, walks, config)
    with Image.open(tmp_path / "film.webp") as picture:
        assert (picture.size, picture.n_frames, picture.info["loop"]) == ((640, 432), 3, 0)
    write_strip(tmp_path / "strip.png", ROBOT, walks, config)
    with Image.open(tmp_path / "strip.png") as picture:
        assert picture.size == (2 * 192, 2 * 324)


def test_back_ends_are_tried_in_turn_and_none_is_one_line(tmp_path, monkeypatch):
    said = (
        "warning\nTraceback (most recent call last):\n  File a\nKeyError: 'sky'\n"
        "Exception ignored in: x\nTraceback (most recent call last):\n  File b\nEGLError: (\n)\n"
    )
    works = {"osmesa"}

    def child(words, *, cwd, env, **options):
        if env["MUJOCO_GL"] not in works:
            return subprocess.CompletedProcess(words, 1, "", said)
        (cwd / "drawn.mp4").write_bytes(b"film")
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    instead(monkeypatch, video.subprocess, "run", child)
    walks, film = dict.fromkeys("ab", motion(ROBOT, pretend_walk(seconds=0.1))), tmp_path / "a.mp4"
    assert write_film(film, ROBOT, walks) == "osmesa"
    assert film.read_bytes() == b"film"
    works.clear()
    film.unlink()
    line = r"no film: .*\(egl: KeyError: 'sky'; osmesa: .*"
    with pytest.raises(VideoUnavailable, match=line) as told:
        write_film(film, ROBOT, walks)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_filmed_is_refused(tmp_path):
    with pytest.raises(ValueError, match="two walks side by side, got 1"):
        write_film(tmp_path / "film.mp4", ROBOT, {"a": motion(ROBOT, pretend_walk(seconds=0.1))})
    with pytest.raises(InputError, match=r"must end in .mp4, .webp, .gif, .png, got film.avi"):
        video.check_film(tmp_path / "film.avi")
