"""What a run leaves behind: metrics, tables, EXR frames, plots and a page."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .pages.attack import write_report as write_report
    from .pages.compare import write_compare_report as write_compare_report
    from .pages.fit import write_fit_report as write_fit_report
    from .pages.policy import write_policy_page as write_policy_page

__getattr__, __dir__ = lazy(__name__)
