"""What pyproject.toml cannot say: a .pth file, in wheels and in editable installs.

Run by setuptools alone.
"""

from pathlib import Path
from typing import Any

from setuptools.command.build_py import build_py

NAME = "mi_nerfattack_llvm"


class BuildWithPath(build_py):
    """Put before_drjit.py next to the package, with the .pth file that imports it."""

    def run(self) -> None:
        """Build, and write both where site-packages is filled from."""
        super().run()
        install: Any = self.get_finalized_command("install")
        folder = Path(install.install_lib if self.editable_mode else self.build_lib)
        folder.mkdir(parents=True, exist_ok=True)
        hook = Path(__file__).with_name("before_drjit.py")
        (folder / f"{NAME}.py").write_text(hook.read_text("utf-8"), "utf-8")
        (folder / f"{NAME}.pth").write_text(f"import {NAME}\n", "utf-8")
