"""`python -m pdkit VERB` is the same as `pdkit VERB`."""
import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
