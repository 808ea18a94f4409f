from .finished import Run as Run
from .job import Job as Job
from .job import attack_policy as attack_policy
