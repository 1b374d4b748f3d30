"""The virtual model of a hand and its blocks, and the gap between it and a recording.

Names not listed here are internal.
"""

from hmmseg._lazy import lazily

__getattr__, __dir__, __all__ = lazily(__name__, __file__)
