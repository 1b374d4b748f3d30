"""Every numeric constant of the product says what kind of number it is, and why it has its value."""

import experiments.constants as table


def test_every_constant_has_a_kind_and_a_reason():
    assert [f"{c.file}: {c.name}" for c in table.every() if c.kind == "unstated" or not c.reason] == []


def test_comments_are_read_as_they_are_meant(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "ROOT", tmp_path)
    (tmp_path / "module.py").write_text("# physics: m/s^2\nGRAVITY = 9.81\n"
                                        "FEWEST = 6  # chosen: samples of a window\n"
                                        "# prior: s on either side\n"
                                        "REACH = 0.03\n"
                                        "LONG = 4.0  # numerics: goes on\n# below it\n"
                                        "NAMES = ('a', 'b')\nBARE = 3.0\n")  # fmt: skip
    found = [(c.name, c.value, c.kind, c.reason) for c in table.constants(tmp_path / "module.py")]
    assert found == [("GRAVITY", "9.81", "physics", "m/s^2"),
                     ("FEWEST", "6", "chosen", "samples of a window"),
                     ("REACH", "0.03", "prior", "s on either side"),
                     ("LONG", "4.0", "numerics", "goes on below it"),
                     ("BARE", "3.0", "unstated", "")]  # fmt: skip
