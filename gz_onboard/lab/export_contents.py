"""What a log holds, for one who wants something out of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from gz_onboard.can.codec import BACK_NS
from gz_onboard.lab.export_tables import recorded_messages
from gz_onboard.recording import logs
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.reports.results import clock, text_rows


@dataclass(frozen=True)
class Contents:
    """Of a log; times in ns since the epoch, None if nothing in it has one. back: frames earlier than one before;
    topics: rows by topic.
    """

    log: Path
    metadata: dict[str, str]
    attached: list[str]
    frames: int
    back: int
    first: int | None
    last: int | None
    topics: dict[str, int]
    damages: list[str]


def log_contents(log: Path) -> Contents:
    """What `log` holds, by reading it whole; InputError if it cannot be read."""
    damages: list[LogDamage] = []
    frames = logs.read_log(log, on_damage=damages.append)
    stamps = frames.time_ns
    back = int((stamps < np.maximum.accumulate(stamps) - BACK_NS).sum())
    times = [int(stamps.min()), int(stamps.max())] if len(frames) else []
    topics: Counter[str] = Counter()
    for topic, time_ns, _ in logs.read_samples(log):
        topics[topic] += 1
        times = [min([time_ns, *times]), max([time_ns, *times])]
    metadata, attached = logs.read_metadata(log), sorted(logs.read_attachments(log))
    first, last = times or (None, None)
    return Contents(log, metadata, attached, len(frames), back, first, last, dict(topics), list(map(str, damages)))


def contents_text(found: Contents) -> str:
    """For a terminal."""
    rows = [(name, text) for name, text in found.metadata.items() if name in ("vehicle", "source")]
    if found.first is not None and found.last is not None:
        begin = datetime.fromtimestamp(found.first // 1_000_000_000, UTC)
        rows.append(("time", f"{clock((found.last - found.first) * 1e-9)} from {begin:%Y-%m-%d %H:%M:%S} UTC"))
    back = f", {found.back} of them earlier than others before them" if found.back else ""
    rows.append(("frames", f"{found.frames}{back}" if found.frames else "none"))
    messages = {f"/can/{name}" for name in recorded_messages(found.log)}
    rows += [(topic.strip("/"), f"{count} rows") for topic, count in found.topics.items() if topic not in messages]
    if messages:
        rows.append(("signals", f"decoded, of {len(messages)} messages: {', '.join(sorted(m[5:] for m in messages))}"))
    rows += [("DBC files", ", ".join(found.attached))] if found.attached else []
    return text_rows(str(found.log), rows + [("damaged", text) for text in found.damages])
