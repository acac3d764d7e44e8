"""What the tests of the pages share: the generator's module."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "docs"))  # the module `generated`
