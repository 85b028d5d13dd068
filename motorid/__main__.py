"""``python -m motorid``."""

from motorid.cli.app import main

if __name__ == "__main__":
    main()
