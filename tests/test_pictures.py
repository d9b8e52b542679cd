"""Pictures of README and docs: each is there, small, and drawn by a script."""

import pytest
from pictures import PICTURES, Flags, draw_method, draw_race
from PIL import Image

from hector_jax.core.inputs import InputError


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_there_and_small(name):
    path, _ = PICTURES[name]
    assert 10_000 < path.stat().st_size < (1_000_000 if name == "film" else 400_000)


def test_the_film_moves_for_four_seconds():
    with Image.open(PICTURES["film"][0]) as film:
        assert film.n_frames == 49
        assert film.width >= 720


def test_diagram_and_race_are_drawn_from_what_is_in_the_repository(tmp_path):
    draw_method(tmp_path / "method.svg")
    draw_race(tmp_path / "race.png")
    assert "<svg" in (tmp_path / "method.svg").read_text()
    assert (tmp_path / "race.png").stat().st_size > 10_000


def test_an_unknown_picture_is_refused_in_one_line():
    with pytest.raises(InputError, match="must be of method, film"):
        Flags(names=("strip",))
