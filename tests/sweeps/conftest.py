"""Processes for the tests of sweeps."""

import multiprocessing
import os
import sys

import pytest

import swept_pendulums

USED = ("xarray", "zarr", "dask.array", "distributed.cli.dask_scheduler", "distributed.cli.dask_worker")


@pytest.fixture(scope="module")
def forked():
    """`forked(function, *arguments, words=path)`: a process that calls a function of the study's module and writes what it says
    into a file. It is forked from one that has imported everything and started nothing, and so is there at once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["swept_pendulums", *USED])

    def begin(function, *arguments, words=os.devnull):
        process = context.Process(target=swept_pendulums.called, args=(words, function, *arguments))
        process.start()
        return process

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
        yield begin
