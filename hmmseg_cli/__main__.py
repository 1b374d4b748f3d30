"""`python -m hmmseg_cli`: the command of this very code, also where it is not installed or another one is."""

from hmmseg_cli import run

if __name__ == "__main__":
    run()
