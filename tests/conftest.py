"""Before anything imports numpy; and how hypothesis goes about it."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the command line does: two workers with two threads each are slow

from hypothesis import settings

settings.register_profile("unhurried", deadline=None)  # on top of the profile of CI, if that is loaded
settings.load_profile("unhurried")  # how long an example takes is the machine's business
