from .run import run_drives as run_drives
from .spec import DriveSpec as DriveSpec
from .store import Store as Store
from .table import drives_table as drives_table
from .table import records as records
