"""A web server on this machine that can break off an answer, change a file or stop."""

import hashlib
import http.server

CONTENT = bytes(range(256)) * 2000


class Server(http.server.ThreadingHTTPServer):
    """A server of `files`, which breaks off after `break_after` bytes of an answer."""

    files: dict[str, bytes]
    break_after: int | None = None
    ranges = True
    asked: list[tuple[str, str | None]]


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        assert isinstance(server, Server)
        asked = self.headers.get("Range")
        server.asked.append((self.path, asked))
        content = server.files.get(self.path)
        if content is None:
            self.send_error(404)
            return
        etag = f'"{hashlib.md5(content).hexdigest()}"'
        start = 0
        if asked and server.ranges and self.headers.get("If-Range", etag) == etag:
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            if start >= len(content):
                self.send_error(416)
                return
        self.send_response(206 if start else 200)
        self.send_header("ETag", etag)
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        body = content[start:]
        self.wfile.write(body if server.break_after is None else body[: server.break_after])

    def log_message(self, *args):
        pass


def url(server: Server, path: str = "/file") -> str:
    return f"http://127.0.0.1:{server.server_address[1]}{path}"
