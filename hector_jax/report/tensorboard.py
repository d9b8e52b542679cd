"""TensorBoard event files made from a run's metrics.jsonl, which remains the reference."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hector_jax.core.files import make_folder
from hector_jax.core.inputs import require_package
from hector_jax.runs.folder import read_metrics


def write_events(folder: Path, out: Path) -> list[Path]:
    """Write the tunings of a run as scalars, each in a folder of its own under `out`.

    Scalars are `loss/*` in the units of metrics.jsonl, `step/*`, `weights/*`, `gradient_log/*` and,
    for numbers beside Q and R, `gradient/*`, by iteration. Files of an earlier call are replaced,
    so it can be called again while the run goes on.

    Args:
        folder: folder of the run.
        out: folder for `tensorboard --logdir`.

    Returns:
        The folders, one for each tuned set.

    Raises:
        InputError: there is no run, tensorboardX is not installed, or a folder cannot be written.
    """
    require_package("tensorboardX", "tensorboard", "TensorBoard")
    from tensorboardX import SummaryWriter

    lines = read_metrics(folder)
    folders = {name: out / name for name in dict.fromkeys(line["set"] for line in lines)}
    for name, set_folder in folders.items():
        make_folder(set_folder)
        for old in set_folder.glob("events.out.tfevents.*"):
            old.unlink()
        with SummaryWriter(str(set_folder)) as writer:
            for line in (line for line in lines if line["set"] == name):
                for key, value in _scalars(line).items():
                    if isinstance(value, int | float):  # skips null (not finite) and lists (gains)
                        writer.add_scalar(key, float(value), line["iteration"])
    return list(folders.values())


def _scalars(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers of an iteration by group and name."""
    return {
        **{f"loss/{name}": line[name] for name in line if name == "L" or name.startswith("L_")},
        **{f"step/{name}": line.get(name) for name in ("step", "accepted", "residual")},
        **{f"weights/{name}": value for name, value in line["weights"].items()},
        **{f"gradient_log/{name}": value for name, value in line["gradient_log"].items()},
        **{f"gradient/{name}": value for name, value in line.get("gradient", {}).items()},
    }
