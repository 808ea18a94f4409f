from .pages.compare import write_compare_report as write_compare_report
from .pages.fit import write_fit_report as write_fit_report
from .pages.policy import write_policy_page as write_policy_page
from .pages.results import write_results_page as write_results_page
