from .job import Job as Job
from .job import attack_policy as attack_policy
from .run_folder import Run as Run
