"""A network that fails: bytes pass through, late or not at all."""

import socket
import threading
import time
from contextlib import ExitStack, contextmanager, suppress


class Proxy:
    """Passes connections on to a server.

    Args:
        cuts_bytes: after so many bytes from the client the first, second, ... connection is cut;
            those after the last stay whole.
        delay_s: every piece arrives so much later.
    """

    def __init__(self, port, cuts_bytes=(), delay_s=0.0):
        self._port = port
        self._cuts_bytes = list(cuts_bytes)
        self._delay_s = delay_s
        self.connection_count = 0
        self.cut_count = 0

    def serve(self, listener):
        """Until the listener is shut down; every connection has ended then."""
        threads = []
        with ExitStack() as connections, suppress(OSError):
            while True:
                client, _ = listener.accept()
                server = socket.create_connection(("127.0.0.1", self._port))
                for end in (client, server):
                    connections.enter_context(end)
                    connections.callback(_shut, end)
                threads += self._connected(client, server)
        for thread in threads:
            thread.join()

    def _connected(self, client, server):
        self.connection_count += 1
        cut_bytes = self._cuts_bytes.pop(0) if self._cuts_bytes else None
        directions = ((client, server, cut_bytes), (server, client, None))
        threads = [threading.Thread(target=self._pass_on, args=ends) for ends in directions]
        for thread in threads:
            thread.start()
        return threads

    def _pass_on(self, source, target, left_bytes):
        with suppress(OSError):
            while data := source.recv(16_384):
                time.sleep(self._delay_s)
                if left_bytes is not None and len(data) > left_bytes:
                    target.sendall(data[:left_bytes])
                    self.cut_count += 1
                    break
                target.sendall(data)
                left_bytes = left_bytes and left_bytes - len(data)
        _shut(source)
        _shut(target)


def _shut(end):
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)


@contextmanager
def proxied(port, **options):
    """A proxy in front of a server, and its address."""
    proxy = Proxy(port, **options)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=proxy.serve, args=(listener,))
        thread.start()
        try:
            yield proxy, f"127.0.0.1:{listener.getsockname()[1]}"
        finally:
            _shut(listener)
            thread.join()
