"""`python -m gsencoder`, which is what `torchrun -m gsencoder` starts."""

import sys

from gsencoder.app.main import main

if __name__ == "__main__":
    sys.exit(main())
