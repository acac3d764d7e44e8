"""What runs, in which order, on how many workers; and the command line."""

from epipole.schemas.one_thread import use_one_thread

use_one_thread()
