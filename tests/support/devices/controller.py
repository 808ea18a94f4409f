"""The stand-in of a VESC as a process that a test starts, tells and reads."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

PROGRAM = Path(__file__).with_name("vesc.py")


class StandIn:
    """A stand-in in a process of its own, for a test.

    Args:
        log: file for its log.
        options: of the command line.
    """

    def __init__(self, log: Path, *options: str) -> None:
        command = [sys.executable, str(PROGRAM), "--log", str(log), *options]
        pipe = subprocess.PIPE
        self.path = log
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        assert self.process.stdout is not None
        self.port = self.process.stdout.readline().strip()
        self.wait_for_line()  # what reads the log finds one

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def log(self) -> list[dict[str, Any]]:
        text = self.path.read_text()
        return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]

    def wait_for(self, **fields: Any) -> list[dict[str, Any]]:
        """Return the log from the last command on, once its last line is as wanted."""
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            lines = self.log()
            if lines and fields.items() <= lines[-1].items():
                starts = [
                    i for i, line in enumerate(lines) if "command" in line["event"]
                ]
                return lines[starts[-1] if starts else 0 :]
            time.sleep(0.02)
        raise TimeoutError(f"{self.path}: never {fields}")

    def wait_for_line(self, **fields: Any) -> None:
        """Return once the log has a line as wanted."""
        deadline = time.monotonic() + 30
        while not any(fields.items() <= line.items() for line in self.log()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self.path}: never {fields}")
            time.sleep(0.02)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
