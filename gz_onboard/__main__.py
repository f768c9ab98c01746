"""``python -m gz_onboard``."""

import sys

from gz_onboard.cli import main

sys.exit(main())
