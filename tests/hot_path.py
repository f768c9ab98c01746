"""The functions that every frame and every window pass through: ``python -m tests.hot_path`` lists them by file."""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType

import gz_onboard
from gz_onboard.events import Frame
from gz_onboard.pipeline import TICK_NS, Pipeline
from gz_onboard.recording.logs import read_frames
from tests.support import LOGS, S, reference

PACKAGE = Path(gz_onboard.__file__).parent
LOG = LOGS / "city_14C.blf"
WARM_UP_S, COUNTED_S = 20.0, 2.0  # the vehicle has left its first stop, and every sensor has been seen


def portions() -> Iterator[tuple[list[Frame], int]]:
    """The frames of the recorded ride as the daemon takes them: in portions of 0.1 s, each with its end [ns]."""
    frames = [frame for batch in read_frames(LOG) for frame in batch]
    end = frames[0][0] + TICK_NS
    portion: list[Frame] = []
    for frame in frames:
        while frame[0] > end:
            yield portion, end
            end, portion = end + TICK_NS, []
        portion.append(frame)


def calls(warm_up: float = WARM_UP_S, seconds: float = COUNTED_S) -> Counter[tuple[Path, str]]:
    """How often each named function of the package is called in `seconds` of the ride, by file and name."""
    counted: Counter[CodeType] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            counted[frame.f_code] += 1

    pipeline, taken = Pipeline(reference()), portions()
    for _ in range(round(warm_up * S / TICK_NS)):
        pipeline.advance(*next(taken))
    before = sys.getprofile()
    for _ in range(round(seconds * S / TICK_NS)):
        portion = next(taken)
        sys.setprofile(count)
        try:
            pipeline.advance(*portion)
        finally:
            sys.setprofile(before)
    found: Counter[tuple[Path, str]] = Counter()
    for code, times in counted.items():
        file = Path(code.co_filename)
        if PACKAGE in file.parents and not code.co_name.startswith("<"):
            found[file.relative_to(PACKAGE), f"{code.co_qualname}:{code.co_firstlineno}"] += times
    return found


def main() -> None:
    """Print the functions by file, and how often each is called in a second."""
    by_file: dict[Path, list[tuple[str, int]]] = defaultdict(list)
    found = calls()
    for (file, name), times in found.items():
        by_file[file].append((name, times))
    for file, functions in sorted(by_file.items()):
        print(f"{file}  {len(functions)} functions")
        for name, times in sorted(functions, key=lambda each: int(each[0].rpartition(":")[2])):
            print(f"  {times / COUNTED_S:8.1f}/s  {name}")
    print(f"{len(by_file)} files, {len(found)} functions")


if __name__ == "__main__":
    main()
