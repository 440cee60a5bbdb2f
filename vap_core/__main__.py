"""`python -m vap_core`: the command line."""

from vap_core.cli import main

if __name__ == "__main__":
    main()
