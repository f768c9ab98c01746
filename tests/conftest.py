"""Before anything imports numpy."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the command line does: two workers with two threads each are slow
