"""The command line in this process."""

import io
import json
import shlex
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from kf_calib.cli import main


class CommandLine:
    """Calls a command: exit code, what it prints, what it prints to the error stream."""

    def __call__(self, *words: object) -> tuple[int, str, str]:
        out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", newline="", write_through=True) for _ in range(2))
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
            patch.setattr(sys, "argv", ["kf-calib", *map(str, words)])
            with pytest.raises(SystemExit) as ended:
                main()
        return int(ended.value.code or 0), *(each.buffer.getvalue().decode() for each in (out, err))

    def json(self, *words: object) -> Any:
        """The object that a command prints, and nothing else."""
        code, out, err = self(*words, "--json")
        assert (code, err) == (0, ""), err
        return json.loads(out)

    def parameters(self, *words: object) -> dict[str, dict[str, Any]]:
        """The parameters that it finds, by their symbols."""
        return {parameter["symbol"]: parameter for parameter in self.json(*words)["parameters"]}

    def proposed(self, path: Path, *words: object) -> tuple[dict[str, Any], list[str]]:
        """What ``info`` says of a file, and the words of the command that it proposes."""
        said = self.json("info", path, *words)
        program, *rest = shlex.split(said["command"])
        assert program == "kf-calib", said["missing"]
        return said, rest

    def refused(self, *words: object) -> str:
        """The one sentence in which a command is refused."""
        code, out, err = self(*words)
        assert (code, out) == (2, "") and err.startswith("kf-calib: ") and err.count("\n") == 1, err
        return err
