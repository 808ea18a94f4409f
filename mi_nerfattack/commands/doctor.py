"""``mi-nerfattack doctor``: tell whether this machine can run the main job."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doctor:
    """Check the installation, and say what to do about each thing that is missing.

    The exit code is 0 where the main job can run, else 1.
    """

    json: bool = False
    """Print JSON in place of the table."""

    def run(self) -> int:
        """Print the findings."""
        from mi_nerfattack.system import doctor

        findings = doctor.examine()
        if self.json:
            print(doctor.to_json(findings))
        else:
            doctor.print_table(findings)
        return 0 if doctor.can_run(findings) else 1
