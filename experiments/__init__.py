"""Scripts that make the published numbers."""

from hmmseg.jaxconfig import configure

configure()  # before any array: double precision
