"""Read the next frames' silhouettes while this one is carved.

Decoding runs outside of Python's lock, so a second core takes it over. At most `n_ahead` frames are held
beside the one in work: a long recording needs no more memory than a short one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

from capture.recording import Silhouettes


@contextmanager
def silhouettes_ahead(
    read: Callable[[int], Silhouettes], frame_ids: Sequence[int], n_ahead: int = 1
) -> Iterator[Iterator[Silhouettes]]:
    """The frames' silhouettes in order, each what `read` (`Recording.silhouettes`) gives.

    One thread reads, since a recording's source is asked by one at a time. On leaving (also by an error or
    Ctrl-C) what has not begun is dropped and the frame being read is waited for.
    """
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="silhouettes") as pool:
        waiting: deque[Future[Silhouettes]] = deque()

        def in_order() -> Iterator[Silhouettes]:
            # An error in the reading thread is raised here, at its own frame.
            for frame_id in frame_ids:
                waiting.append(pool.submit(read, frame_id))
                if len(waiting) > n_ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

        try:
            yield in_order()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
