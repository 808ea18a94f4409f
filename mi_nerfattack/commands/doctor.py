"""``mi-nerfattack doctor``: tell whether the package can run on this machine."""

from __future__ import annotations

from dataclasses import dataclass

from mi_nerfattack.commands.shared.terminal import Result


@dataclass(frozen=True)
class Doctor:
    """Check the installation, and say how to get what is missing.

    The exit code is 0 where the package can run, else 1: extras may be absent.
    """

    json: bool = False
    """Print one line of JSON instead of the table."""

    developer: bool = False
    """Also list what only tests, checks of the code and the documentation need."""

    def run(self) -> Result:
        """Print the findings."""
        from mi_nerfattack.system import doctor

        findings = doctor.examine(self.developer)
        return Result(
            doctor.document(findings),
            lambda: doctor.print_table(findings),
            0 if doctor.can_run(findings) else 1,
        )
