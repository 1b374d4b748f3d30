"""The diagnosis of a robot's logs against any simulator of it: windows, sensitivities, verdict."""
