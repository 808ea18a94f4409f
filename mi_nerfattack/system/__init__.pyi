from .heap import map_large_blocks as map_large_blocks
from .workers import InThisProcess as InThisProcess
from .workers import Processes as Processes
from .workers import available_cores as available_cores
