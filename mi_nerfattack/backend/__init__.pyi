from .determinism import deterministic as deterministic
from .determinism import one_thread as one_thread
from .variant import ensure as ensure
