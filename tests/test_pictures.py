"""Pictures of README and docs: each is there, small, and drawn by a script."""

from pictures import PICTURES, draw_method, draw_race
from PIL import Image


def test_pictures_are_there_and_small_and_diagram_and_race_are_drawn_again(tmp_path):
    for name, (path, _) in PICTURES.items():
        assert 10_000 < path.stat().st_size < (1_000_000 if name == "film" else 400_000)
    with Image.open(PICTURES["film"][0]) as film:
        assert (film.n_frames, film.width >= 720) == (49, True)  # four seconds
    draw_method(tmp_path / "method.svg")
    draw_race(tmp_path / "race.png")
    assert "<svg" in (tmp_path / "method.svg").read_text()
    assert (tmp_path / "race.png").stat().st_size > 10_000
