"""``python -m xreset`` is the same as the console script ``xreset``."""

from xreset.cli import main

if __name__ == "__main__":
    main()
