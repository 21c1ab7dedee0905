"""The processes or the Dask cluster that work on the recordings of a call."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any, TypeVar

from ehadiag.core.interruption import children_with_safe_path
from firmware_iface.errors import ConfigurationError, InputOutputError, install_command

if TYPE_CHECKING:
    from distributed import Client


Given = TypeVar("Given")
Made = TypeVar("Made")


def worker_count(count: int) -> int:
    """Return how many workers so many inputs are worth on this machine; 1: none beside this."""
    from joblib import cpu_count  # noqa: PLC0415

    # Inputs that make a worker of one's own worth its start.
    return max(1, min(int(cpu_count()), count // 8))


class Workers:
    """Processes of this machine, or those of a Dask cluster that is already there.

    A worker that dies takes nothing with it: what it had not delivered is done again, and an
    input that ends a worker twice, the second time alone, is given up.

    jobs: processes; on a cluster it has no meaning; cluster: address of the cluster's scheduler;
    None: this machine.
    """

    def __init__(self, jobs: int, cluster: str | None = None) -> None:
        self._jobs = jobs
        self._stack = ExitStack()
        self._client: Client | None = None
        self._stack.enter_context(children_with_safe_path())
        if cluster is not None:
            self._client = self._stack.enter_context(_dask_client(cluster))
            self._jobs = max(1, sum(self._client.nthreads().values()))

    @property
    def count(self) -> int:
        """Workers at the same time."""
        return self._jobs

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def over(
        self,
        work: Callable[[Given], Made],
        inputs: Sequence[Given],
        give_up: Callable[[Given], Made],
    ) -> Generator[Made, None, None]:
        """Give what the function makes of each input, in order.

        So many are under way at once that the workers are busy, and no more: memory does not grow
        with the number of inputs.

        work: function, which can be sent to another process; give_up: what stands for an input that
        ends each process which takes it.
        """
        at = 0
        while at < len(inputs):
            # Under way, or waiting for those before them.
            part = inputs[at : at + 128 * self._jobs]
            try:
                for made in self._run(work, part):
                    at += 1
                    yield made
            except BrokenExecutor:
                # One of those that were under way did it.
                for given in inputs[at : at + self._jobs]:
                    at += 1
                    yield self._alone(work, given, give_up)

    def _alone(
        self,
        work: Callable[[Given], Made],
        given: Given,
        give_up: Callable[[Given], Made],
    ) -> Made:
        try:
            (made,) = self._run(work, [given])
        except BrokenExecutor:
            return give_up(given)
        return made

    def _run(
        self, work: Callable[[Given], Made], part: Sequence[Given]
    ) -> Generator[Made, None, None]:
        if self._client is not None:
            yield from _run_on_cluster(self._client, work, part)
            return
        from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415

        # One process more than none: joblib would else work in this one.
        with parallel_config("loky", n_jobs=max(self._jobs, 2), inner_max_num_threads=1):
            parallel = Parallel(return_as="generator", batch_size=1, pre_dispatch="2*n_jobs")
            with closing(parallel(delayed(work)(item) for item in part)) as made:
                yield from made


def _dask_client(address: str) -> Any:
    try:
        from distributed import Client  # noqa: PLC0415 - optional, and slow
    except ImportError:
        raise ConfigurationError(f"--cluster: needs Dask: {install_command('dask')}") from None
    try:
        return Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:  # OSError is also that nobody answers in time
        why = " ".join(str(error).split())
        raise InputOutputError(f"cluster {address}: {why or 'no scheduler answers'}") from None


def _run_on_cluster(
    client: Client, work: Callable[[Given], Made], part: Sequence[Given]
) -> Generator[Made, None, None]:
    """Run on the cluster; what a worker that dies had in hand, the scheduler gives to others."""
    from distributed.scheduler import KilledWorker  # noqa: PLC0415

    futures = client.map(work, part, pure=False)
    try:
        for future in futures:
            yield future.result()
            future.release()
    except KilledWorker as error:
        raise BrokenExecutor(str(error)) from None
    finally:
        client.cancel(futures)
