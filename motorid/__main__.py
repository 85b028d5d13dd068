"""``python -m motorid``."""

from motorid.cli import main

if __name__ == "__main__":
    main()
