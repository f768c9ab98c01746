"""Pictures: one place writes PNG, SVG and PDF, the same bytes for the same figure."""

from __future__ import annotations

import re

import pytest

from gz_onboard.errors import InputError
from gz_onboard.reports.page import image
from gz_onboard.reports.style import new_figure, save


def figure():
    drawn = new_figure(2, 1)
    drawn.add_subplot().set_xlabel("speed [m/s]")
    return drawn


@pytest.mark.parametrize(("kind", "begin"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_a_picture_is_what_its_name_says(kind, begin, tmp_path):
    for name in ("a", "b"):
        save(figure(), tmp_path / f"{name}.{kind}")
    first, second = ((tmp_path / f"{name}.{kind}").read_bytes() for name in ("a", "b"))
    assert first.startswith(begin)
    assert first == second
    assert not {b"CreationDate", b"dc:date"} & set(re.findall(rb"CreationDate|dc:date", first))  # of whole seconds
    if kind == "svg":
        assert b"speed [m/s]" in first  # words, not outlines
    shown = image(tmp_path / f"a.{kind}")
    assert ("href='a.pdf'" if kind == "pdf" else f"data:image/{'svg+xml' if kind == 'svg' else 'png'};base64,") in shown


def test_another_name_is_no_picture(tmp_path):
    with pytest.raises(InputError, match=r"a\.gif: the picture's name has to end in one of \.png, \.svg, \.pdf"):
        save(figure(), tmp_path / "a.gif")
