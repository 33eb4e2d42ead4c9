"""The dashboard server of a UR controller, asked over a fresh connection each time.

It is the second way to the controller: it works while the vendor library hangs.
"""

import socket


class Dashboard:
    """Asks one line, returns one line."""

    def __init__(self, host: str, timeout_s: float = 1.0) -> None:
        self._address = (host, 29999)
        self._timeout_s = timeout_s

    def ask(self, line: str) -> str:
        """Return the controller's answer to one line.

        Raises:
            OSError: the controller cannot be reached or does not answer in time.
        """
        with socket.create_connection(self._address, self._timeout_s) as link:
            link.settimeout(self._timeout_s)
            with link.makefile("rw", newline="\n") as lines:
                lines.readline()
                lines.write(line + "\n")
                lines.flush()
                answer = lines.readline().strip()
        if not answer:
            raise OSError(f"the dashboard server of {self._address[0]} closed the connection")
        return answer
