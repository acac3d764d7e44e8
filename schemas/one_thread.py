"""One thread per task: the libraries of linear algebra start no threads.

Tasks run in parallel, and their matrices are small. Threads within a task wait for each other more
than they compute: on two cores the check of the sensors took fifteen times the CPU. The last bits
of a product may depend on them, too.
"""

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def use_one_thread() -> None:
    """Let these libraries use one thread, unless the user's environment says otherwise.

    They read the variables when numpy or scipy are first imported.
    """
    for name in _VARIABLES:
        os.environ.setdefault(name, "1")
