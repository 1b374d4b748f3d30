"""Plain ordered tasks over arbitrary channels."""
