"""Controller time to host time."""

from collections import deque


class ClockOffset:
    """Offset from controller clock to host clock as a running minimum.

    A package can only arrive late, never early, so the smallest difference between arrival and
    stamp is the best estimate; the window lets it follow the drift between two quartz clocks.
    """

    def __init__(self, window_ns: int = 10_000_000_000) -> None:
        self._window_ns = window_ns
        self._minima: deque[tuple[int, int]] = deque()
        self._newest_ns = -1

    def host_ns(self, stamp_s: float, arrived_ns: int) -> int:
        """Return the host time of a controller stamp that arrived at `arrived_ns`.

        Results of successive packages increase strictly, also where the estimate improves.
        """
        controller_ns = round(stamp_s * 1e9)
        offset_ns = arrived_ns - controller_ns
        while self._minima and self._minima[-1][1] >= offset_ns:
            self._minima.pop()
        self._minima.append((arrived_ns, offset_ns))
        while self._minima[0][0] < arrived_ns - self._window_ns:
            self._minima.popleft()
        self._newest_ns = max(self._newest_ns + 1, controller_ns + self._minima[0][1])
        return self._newest_ns
