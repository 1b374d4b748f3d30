"""Simulators that a recording is compared with: the protocol, any Python object, MuJoCo models."""
