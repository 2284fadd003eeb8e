"""What takes long says what it does, where somebody sees it, and the outermost only."""

import io
import logging
import os
import pty
import subprocess
import sys
import time

import pytest
from rich.console import Console

import jaxbelt as jb
from jaxbelt import activity
from jaxbelt.activity import Activity, announced, note_progress
from jaxbelt.sweeps.progress import SweepProgress


@pytest.fixture
def screen(monkeypatch):
    """What is shown at once on a terminal."""
    text = io.StringIO()
    monkeypatch.setattr(activity, "_console", Console(file=text, force_terminal=True, width=100))
    monkeypatch.setattr(activity, "SHOWN_AFTER", 0.0)
    yield text
    jb.show_progress(None)


def wait_for(shown, text):
    for _ in range(200):
        if text in shown.getvalue():
            return True
        time.sleep(0.02)
    return False


@announced("outer")
def outer(shown):
    assert wait_for(shown, "outer: the first time it is compiled")
    inner()
    assert wait_for(shown, "outer: half of it")


@announced("inner")
def inner():
    note_progress("half of it")


def test_the_outermost_activity_has_the_line(screen, monkeypatch):
    monkeypatch.setattr(Activity, "known", set())
    outer(screen)
    assert "inner" not in screen.getvalue()
    assert Activity.under_way == [] and Activity.known == {"outer", "inner"}


def test_a_sweep_within_another_activity_tells_it(screen):
    with Activity("basins"):
        with SweepProgress(100, 20, None) as bar:
            assert bar.bar is None
            bar.advance({0: 30})
        assert wait_for(screen, "basins: 50 of 100 runs")


def test_what_fails_ends_its_line(screen):
    @announced("failure")
    def fail():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert Activity.under_way == [] and "failure" not in Activity.known


def test_nothing_is_shown_where_it_is_not_wanted(screen):
    jb.show_progress(False)
    with Activity("silence"):
        time.sleep(0.1)
    with Activity("silence", wanted=False):
        time.sleep(0.1)
    assert screen.getvalue() == ""


def test_the_logger_is_told(caplog):
    with caplog.at_level(logging.DEBUG, logger="jaxbelt"), Activity("search"):
        note_progress("3 of 7")
    first, last = (record.getMessage() for record in caplog.records)
    assert first == "3 of 7" and last.startswith("search: ")


PROGRAM = """
import sys, time
from jaxbelt.activity import announced
@announced("a long search")
def search():
    time.sleep(2.7)
search()
"""


@pytest.mark.parametrize(
    "on_terminal", [True, pytest.param(False, marks=pytest.mark.slow(first=True))]
)
def test_a_terminal_sees_what_takes_longer_than_two_seconds_and_a_pipe_does_not(on_terminal):
    ends = pty.openpty() if on_terminal else os.pipe()
    with os.fdopen(ends[0], "rb", buffering=0) as here:
        environment = {**os.environ, "TERM": "xterm"}
        command = [sys.executable, "-c", PROGRAM]
        child = subprocess.Popen(command, stderr=ends[1], env=environment)
        assert child.wait(timeout=60) == 0
        os.set_blocking(ends[0], False)
        try:
            seen = here.read(100_000) or b""
        except OSError:
            seen = b""
        os.close(ends[1])
    assert (b"a long search" in seen) == on_terminal
