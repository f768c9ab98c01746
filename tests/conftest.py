"""Before anything imports numpy."""

import os

from hypothesis import settings

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the command line does: two workers with two threads each are slow
settings.register_profile("project", deadline=None)  # what is slow on a busy machine is not wrong
settings.load_profile("ci" if "CI" in os.environ else "project")
