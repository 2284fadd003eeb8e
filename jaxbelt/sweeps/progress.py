"""Progress of a sweep: one line on the terminal."""

import threading
import time
from collections import Counter
from collections.abc import Mapping

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..activity import SHOWN_AFTER, Activity, is_wanted, note_progress, progress_line
from ..results import Status


class SweepProgress:
    """A bar on the terminal, for sweeps that take longer than a moment.

    It says "compiling" until the first runs are done, then how many there are, how many in a
    second, and how many ended with another status than OK. Runs of an earlier call count as done,
    but not for the time that is left. Within another activity there is no bar; the line of that
    activity shows the progress.
    """

    def __init__(self, total: int, done: int, wanted: bool | None):
        self.bar: Progress | None = None
        self.total, self.completed = total, done
        if not (is_wanted() and not Activity.under_way if wanted is None else wanted):
            return
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:,.0f} of {task.total:,.0f} runs{task.fields[detail]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.bar = progress_line(*columns)
        self.task = self.bar.add_task("compiling", total=total, completed=done, detail="")
        self.patience = threading.Timer(0.0 if wanted else SHOWN_AFTER, self._show)
        self.patience.daemon = True
        self.lock, self.ended = threading.Lock(), False
        self.statuses: Counter[int] = Counter()
        self.began: float | None = None

    def __enter__(self) -> "SweepProgress":
        if self.bar is not None:
            self.patience.start()
        return self

    def _show(self) -> None:
        with self.lock:
            if self.bar is not None and not self.ended:
                self.bar.start()

    def advance(self, counts: Mapping[int, int]) -> None:
        """Counts further runs, by status."""
        now, more = time.monotonic(), sum(counts.values())
        self.completed += more
        if self.bar is None:
            note_progress(f"{self.completed:,} of {self.total:,} runs")
            return
        with self.lock:
            # The first results may come long after the first runs began; they give no rate.
            known = 0 if self.began is None else self.statuses.total() + more
            self.began = self.began or now
            self.statuses.update(counts)
            others = {Status(k).name.lower(): n for k, n in self.statuses.items() if k != Status.OK}
        detail = f", {known / (now - self.began):,.0f} runs/s" if known and now > self.began else ""
        detail += "".join(f", {count:,} {name}" for name, count in sorted(others.items()))
        self.bar.update(self.task, advance=more, description="sweep", detail=detail)

    def __exit__(self, *_) -> None:
        if self.bar is None:
            return
        self.patience.cancel()
        with self.lock:
            self.ended = True
            if self.bar.live.is_started:
                self.bar.stop()
