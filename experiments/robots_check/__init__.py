"""The diagnosis checked blind on robots that others modelled, with seeded faults drawn here."""
