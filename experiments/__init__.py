"""Scripts that make the published numbers."""

import hmmseg_cli  # noqa: F401  # one BLAS thread, as the command has it, which must be set before NumPy
from hmmseg.jaxconfig import configure

configure()  # before any array: double precision
