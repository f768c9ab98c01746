"""What a log holds, for one who wants something out of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from gz_onboard.bus import logs
from gz_onboard.lab.export_tables import recorded_messages
from gz_onboard.offline.results import clock, text_rows


@dataclass(frozen=True)
class Contents:
    """Of a log; times in ns since the epoch, None if nothing in it has one. topics: rows by topic."""

    log: Path
    metadata: dict[str, str]
    attached: list[str]
    frames: int
    first: int | None
    last: int | None
    topics: dict[str, int]
    damages: list[str]


def log_contents(log: Path) -> Contents:
    """What `log` holds, by reading it whole; InputError if it cannot be read."""
    damages: list[logs.LogDamage] = []
    count, first, last = 0, None, None
    for batch in logs.read_frames(log, on_damage=damages.append):
        count += len(batch)
        first = batch[0][0] if first is None else first
        last = batch[-1][0]
    topics: Counter[str] = Counter()
    for topic, time_ns, _ in logs.read_samples(log):
        topics[topic] += 1
        first = time_ns if first is None else min(first, time_ns)
        last = time_ns if last is None else max(last, time_ns)
    attached = sorted(logs.read_attachments(log))
    return Contents(log, logs.read_metadata(log), attached, count, first, last, dict(topics), list(map(str, damages)))


def contents_text(found: Contents) -> str:
    """For a terminal."""
    rows = [(name, text) for name, text in found.metadata.items() if name in ("vehicle", "source")]
    if found.first is not None and found.last is not None:
        begin = datetime.fromtimestamp(found.first // 1_000_000_000, UTC)
        rows.append(("time", f"{clock((found.last - found.first) * 1e-9)} from {begin:%Y-%m-%d %H:%M:%S} UTC"))
    rows.append(("frames", f"{found.frames}" if found.frames else "none"))
    messages = {f"/can/{name}" for name in recorded_messages(found.log)}
    rows += [(topic.strip("/"), f"{count} rows") for topic, count in found.topics.items() if topic not in messages]
    if messages:
        rows.append(("signals", f"decoded, of {len(messages)} messages: {', '.join(sorted(m[5:] for m in messages))}"))
    rows += [("DBC files", ", ".join(found.attached))] if found.attached else []
    return text_rows(str(found.log), rows + [("damaged", text) for text in found.damages])
