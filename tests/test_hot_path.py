"""Few files and few functions are passed through while riding: each call costs, and each is one more to understand."""

from tests.hot_path import calls

MOST_FILES, MOST_FUNCTIONS = 37, 214
"""Lower them whenever the code gets simpler; ``python -m tests.hot_path`` lists the functions."""


def test_two_seconds_of_a_ride_pass_through_few_files_and_functions():
    found = calls()
    assert len({file for file, _ in found}) <= MOST_FILES
    assert len(found) <= MOST_FUNCTIONS
