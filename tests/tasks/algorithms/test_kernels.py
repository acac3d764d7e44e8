"""Kernels: one that cannot be kept is used all the same."""

import errno

from epipole.tasks.algorithms import kernels


def test_a_kernel_that_cannot_be_kept_is_used_and_said_once(monkeypatch, caplog):
    def full(*_):
        raise OSError(errno.ENOSPC, "no space in this test")

    made = [kernels.kernel(lambda x, k=k: x + k) for k in range(2)]
    for each in made:
        monkeypatch.setattr(each._cache._cache_file, "save", full)
    assert [each(1.0) for each in made] == [1.0, 2.0]  # and no traceback
    said = [r.getMessage() for r in caplog.records if "cannot be kept" in r.getMessage()]
    assert len(said) == 1
    assert "no space in this test" in said[0]
