"""What pyproject.toml cannot say: a .pth file, in wheels and in editable installs."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithPath(build_py):
    """Write the file that lets Dr.Jit find LLVM, see mi_nerfattack_llvm.py."""

    def run(self) -> None:
        """Build, and write it where site-packages is filled from."""
        super().run()
        install = self.get_finalized_command("install")
        folder = install.install_lib if self.editable_mode else self.build_lib
        path = Path(folder) / "mi_nerfattack_llvm.pth"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("import mi_nerfattack_llvm\n", "utf-8")


setup(cmdclass={"build_py": BuildWithPath})
