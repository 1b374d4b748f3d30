"""Results of a segmentation: spans of subtasks with uncertain boundaries."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Span:
    """One subtask's half-open interval [start, end) in s.

    Start and end are posterior medians and may lie between samples; one span's end is the next
    one's start. `*_sd` are posterior standard deviations [s], `*_90` central 90 % intervals [s]
    (of width 0 at the recording's own first and last time).
    """

    subtask: str
    object: str | None
    state: str
    start: float
    end: float
    start_sd: float
    end_sd: float
    start_90: tuple[float, float]
    end_90: tuple[float, float]


@dataclass(frozen=True)
class Failure:
    """The first subtask (0-based index in the task's order) that the recording does not show.

    `repetition` (from 1) says in which round of a repeated task; None where it has but one.
    """

    index: int
    subtask: str
    object: str | None
    reason: str
    repetition: int | None = None

    def __str__(self) -> str:
        step = f"{self.subtask} {self.object or ''}".strip()
        number = "" if self.repetition is None else f"repetition {self.repetition}: "
        return f"does not fit its task at {step}: {number}{self.reason}"

    def to_json(self) -> dict:
        """The entry `failed` of one trial."""
        document = asdict(self)
        if self.repetition is None:
            del document["repetition"]
        return document


@dataclass(frozen=True)
class Segmentation:
    """Spans of one trial; `failed` where the recording does not fit its task.

    `log_evidence` is None from a method that has no likelihood. Of a repeated task, `repetitions` says
    how often the recording shows it and `failures` holds all rounds that do not fit, `failed` the first.
    """

    file: str
    rate: float
    log_evidence: float | None
    spans: tuple[Span, ...]
    failed: Failure | None = None
    repetitions: int | None = None
    failures: tuple[Failure, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether the recording shows every subtask of its task, in order."""
        return self.failed is None

    def to_json(self) -> dict:
        """The entry of one trial in the JSON of `segment`."""
        document = {
            "file": self.file,
            "rate": self.rate,
            "log_evidence": self.log_evidence,
            "complete": self.complete,
            "segments": [asdict(span) for span in self.spans],
        }
        if self.failed is not None:
            document["failed"] = self.failed.to_json()
        if self.repetitions is not None:
            document["repetitions"] = self.repetitions
            document["failures"] = [failure.to_json() for failure in self.failures]
        return document
