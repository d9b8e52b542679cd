"""metrics.jsonl of a run folder while its tunings go on."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from hector_jax.core.files import append_file, write_file
from hector_jax.runs.folder import as_line
from hector_jax.tuning.difftune import Iteration


class Journal:
    """metrics.jsonl, a line for each iteration: as they come; in order when tunings are over."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._histories: dict[str, Sequence[Iteration]] = {}

    def write(self, histories: Mapping[str, Sequence[Iteration]]) -> None:
        """Write the file anew, with these tunings after or instead of those written before.

        Raises:
            WriteError: where the file cannot be written; the old one stays.
        """
        self._histories.update(histories)
        lines = (as_line(name, i) for name, history in self._histories.items() for i in history)
        write_file(self.path, "".join(lines).encode())

    def add(self, name: str, iteration: Iteration) -> None:
        """Write one line more.

        Raises:
            WriteError: where the file cannot be written.
        """
        append_file(self.path, as_line(name, iteration).encode())
