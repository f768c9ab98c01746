"""Every fault that a bus can bring, on a recorded ride: never an exception, never a wrong number, always told."""

import pytest

pytest.register_assert_rewrite("tests.faults.support")
