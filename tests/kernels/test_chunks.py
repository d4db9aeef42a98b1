"""Chunks go on in smaller ones where the memory of a device ends."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.errors import MemoryLimitError
from gmmtorch.kernels import chunks, kernels
from gmmtorch.kernels.mixtures import em_steps
from gmmtorch.mixture.em.exact import quadratic_features

pytestmark = pytest.mark.cpu_only

FULL = "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of 4.00 GiB of which ..."


def limited(most: int, tried: list[int]):
    def compute(part: slice) -> list[int]:
        tried.append(part.stop - part.start)
        if tried[-1] > most:
            raise torch.OutOfMemoryError(FULL)
        return list(range(part.start, part.stop))

    return compute


def test_work_goes_on_in_smaller_chunks(caplog):
    caplog.set_level("INFO")
    tried: list[int] = []
    found = list(chunks.chunked(23, 10, limited(3, tried)))
    assert [row for part in found for row in part] == list(range(23))
    assert tried == [10, 5, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1]
    assert "GPU 0 is out of memory: 2.50 GiB were asked for" in caplog.text
    assert "chunks of 5 rows" in caplog.text
    assert list(chunks.chunked(0, 10, limited(3, tried))) == []


def test_a_row_that_does_not_fit_is_an_error_that_names_bytes_and_options():
    with pytest.raises(MemoryLimitError, match=r"GPU 0 is out of memory: 2.50 GiB were asked.*n_components"):
        list(chunks.chunked(5, 4, limited(0, [])))


def test_an_error_of_another_kind_is_not_repeated():
    with pytest.raises(ZeroDivisionError):
        list(chunks.chunked(5, 4, lambda part: 1 // 0))


def test_an_e_step_without_memory_gives_the_same_statistics(monkeypatch):
    features = quadratic_features(torch.rand(300, 2, dtype=torch.float64))
    weight, natural = torch.rand(300).double(), torch.randn(7, 6).double()
    with kernels("torch"):
        expected = em_steps.expectation(features, weight, natural, torch.float64)
        softmax, largest = em_steps.softmax, []

        def full(logits, *options):
            if logits.shape[1] > 50:
                raise torch.OutOfMemoryError(FULL)
            largest.append(logits.shape[1])
            return softmax(logits, *options)

        monkeypatch.setattr(em_steps, "softmax", full)
        found = em_steps.expectation(features, weight, natural, torch.float64)
    assert max(largest) == 37
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
