"""Films: poses are those that were walked, and no machine's missing back end ends a run."""

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from PIL import Image
from pretend import pretend_walk
from scipy.spatial.transform import Rotation

from hector_jax.evaluation import video
from hector_jax.evaluation.video import VideoConfig, VideoUnavailable, write_video
from hector_jax.robot import MODEL_PATH, load_robot
from hector_jax.trajectory import State


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def test_a_drawn_pose_has_the_walked_centre_of_mass_and_attitude(robot):
    euler, position = np.array([[0.1, -0.2, 2.5]]), np.array([[0.3, -0.4, 0.5]])
    state = State(euler, position, np.zeros((1, 3)), np.zeros((1, 3)))
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    data = mujoco.MjData(model)
    data.qpos = video.poses(robot, state, np.asarray(robot.standing_joints)[None])[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.subtree_com[1], position[0], atol=1e-9)
    expected = Rotation.from_euler("ZYX", euler[0, ::-1]).as_matrix()
    np.testing.assert_allclose(data.xmat[1].reshape(3, 3), expected, atol=1e-9)


def test_a_film_shows_the_state_of_its_time_whatever_the_walks_rate(robot):
    slow, fast = (pretend_walk(seconds=1.0, period=p) for p in (0.01, 0.001))
    found = video._request(VideoConfig(), robot, {"a": slow, "b": fast})
    assert len(found["times"]) == 26
    np.testing.assert_allclose(found["aim_0"], found["aim_1"], atol=0.006)
    np.testing.assert_allclose(found["aim_0"][10], slow.reference.position[39])


def test_a_robot_that_fell_stays_where_it_was_last_seen(robot):
    walks = {"a": pretend_walk(seconds=1.0, fall_at=0.5), "b": pretend_walk(seconds=1.0)}
    found = video._request(VideoConfig(), robot, walks)
    assert found["fall_0"] == pytest.approx(0.5)
    assert np.isinf(found["fall_1"])
    assert np.isfinite(found["pose_0"]).all()
    np.testing.assert_array_equal(found["pose_0"][13], found["pose_0"][-1])


@pytest.mark.filterwarnings("ignore:os.fork")  # of the reader used here, not of the writer
def test_a_film_and_a_strip_are_written_with_the_promised_size(robot, tmp_path):
    walks = {"nominal": pretend_walk(0, 0.05, 0.2), "tuned with net": pretend_walk(1, 0.01, 0.2)}
    film, strip = tmp_path / "film.mp4", tmp_path / "strip.png"
    try:
        write_video(film, robot, walks, strip, VideoConfig(rate=10))
    except VideoUnavailable as error:
        pytest.skip(str(error))
    frames = imageio_ffmpeg.read_frames(film)
    about = next(frames)
    assert about["size"] == (640, 360)
    assert about["fps"] == 10
    pictures = [np.frombuffer(f, np.uint8).reshape(360, 640, 3).astype(int) for f in frames]
    assert len(pictures) == 3
    assert np.ptp(pictures[0][60:300]) > 150
    assert np.abs(pictures[2][:, :320] - pictures[2][:, 320:]).mean() > 1
    with Image.open(strip) as picture:
        assert picture.height == 720


def test_no_back_end_costs_one_line(robot, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "crayon")
    walks = {"a": pretend_walk(seconds=0.1), "b": pretend_walk(seconds=0.1)}
    with pytest.raises(VideoUnavailable, match="no film: .*crayon") as caught:
        write_video(tmp_path / "film.mp4", robot, walks)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_back_ends_are_tried_in_turn_until_one_draws(robot, tmp_path, monkeypatch):
    tried = []

    def draw(folder, back_end):
        tried.append(back_end)
        if back_end == "egl":
            return "no device"
        (folder / "film.mp4").write_bytes(b"film")
        return ""

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(video, "_draw_in_child", draw)
    walks = {"a": pretend_walk(seconds=0.1), "b": pretend_walk(seconds=0.1)}
    assert write_video(tmp_path / "film.mp4", robot, walks) == "osmesa"
    assert tried == ["egl", "osmesa"]
    assert (tmp_path / "film.mp4").read_bytes() == b"film"


def test_a_film_shows_two_walks(robot, tmp_path):
    with pytest.raises(ValueError, match="two walks side by side, got 1"):
        write_video(tmp_path / "film.mp4", robot, {"a": pretend_walk(seconds=0.1)})


@pytest.mark.parametrize("wrong", [{"width": 642}, {"height": 33}, {"rate": 0}, {"speed": 0.0}])
def test_sizes_that_cannot_be_encoded_are_refused(wrong):
    with pytest.raises(ValueError, match=f"VideoConfig.{next(iter(wrong))} must be"):
        VideoConfig(**wrong)
