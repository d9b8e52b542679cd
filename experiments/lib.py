"""What the experiments share: how a report is written."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hector_jax.core.console import made_at
from hector_jax.core.environment import environment
from hector_jax.core.files import write_file, write_json


def write_report(
    path: Path,
    title: str,
    paragraphs: Sequence[str],
    *,
    numbers: Mapping[str, Any],
    json_name: str,
    pictures: Mapping[str, str] | None = None,
) -> Path:
    """Write a report in Markdown and, beside it, its numbers as JSON.

    Args:
        path: the report.
        title: its heading; commit and command follow.
        paragraphs: its text.
        numbers: JSON values; `environment` is added.
        json_name: name of the JSON file, in the report's folder.
        pictures: captions by the names of files in the report's folder.

    Returns:
        The path of the report.
    """
    about = environment()
    shown = [f"![{file}]({file})\n\n{caption}" for file, caption in (pictures or {}).items()]
    text = [f"# {title}", made_at(about), *paragraphs, *shown]
    write_json(path.parent / json_name, {"environment": about, **numbers})
    write_file(path, ("\n\n".join(text) + "\n").encode())
    return path
