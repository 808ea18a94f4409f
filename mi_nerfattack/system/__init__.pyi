from .workers import InThisProcess as InThisProcess
from .workers import Processes as Processes
from .workers import available_cores as available_cores
