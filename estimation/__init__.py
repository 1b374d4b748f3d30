"""From subtask spans to block properties with uncertainty: `identify` gives an `Identification`.

Names that are not listed here are internal.
"""

from hmmseg._lazy import lazily

__getattr__, __dir__, __all__ = lazily(__name__, __file__)
