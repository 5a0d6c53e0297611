"""Who may use the page: checks of host, origin and token before anything else, and headers for browsers."""

import ipaddress
import re
import secrets
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from calgraph.live.refusals import Refusal, Refusals

_HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(?::[0-9]{1,5})?")
# Bytes of randomness, more than can be tried.
_TOKEN_BYTES = 16
# For phones, in letters that are large without a style sheet; browsers ask for no icon where one is given.
_DOCUMENT = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    '<meta name="color-scheme" content="dark"><link rel="icon" href="data:,"><title>calgraph live</title>{}'
    "</html>\n"
)
_OLD_LINK = "This link is not valid any more: open the one that calgraph live shows now."


def make_token() -> str:
    """A random token for the link."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


class AccessCheck:
    """Refuses requests that do not come from the page itself, and counts them.

    A page of another site may make a browser send requests here: by a name that it lets point to this machine (DNS
    rebinding), which the header Host reveals, or by a websocket, which Origin reveals.

    Args:
        app: answers what is allowed.
        token: that the link has; None if only this machine reaches the server.
        names: of hosts, besides literal addresses, which cannot be rebound.
        cookie: name of the cookie that keeps the token.
        refusals: are counted here.
    """

    def __init__(
        self, app: ASGIApp, token: str | None, names: Iterable[str], cookie: str, refusals: Refusals
    ) -> None:
        self._app = app
        self._token = token
        self._names = frozenset(name.lower() for name in names)
        self._cookie = cookie
        self._refusals = refusals

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request, or lets the application answer it."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._count_status(message["status"])
                known = host if self._is_known(host) else ""
                _add_headers(MutableHeaders(scope=message), known, is_local=self._token is None)
            await send(message)

        refusal, answer = self._check(scope, headers, host)
        if refusal:
            self._refusals.add(refusal)
        if answer is None:
            await self._app(scope, receive, send_guarded)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            await answer(scope, receive, send_guarded)

    def _check(self, scope: Scope, headers: Headers, host: str) -> tuple[Refusal | None, Response | None]:
        """The reason of a refusal, and the answer that replaces the application's."""
        if not self._is_known(host):
            return "foreign hosts", _refuse("This address is not that of calgraph live.", 421)
        if scope["type"] == "websocket" and headers.get("origin") != f"http://{host}":
            return "foreign origins", _refuse("", 403)
        if self._token is None:
            return None, None
        given = self._token_of_link(scope)
        if given is not None and scope["type"] == "http":
            if _is_token(given, self._token):
                return None, self._admit()
            return "wrong tokens", _refuse(_OLD_LINK, 403)
        kept = self._token_of_cookie(headers)
        if kept is None:
            return "missing tokens", _refuse("Open the link with the token that calgraph live shows.", 403)
        if not _is_token(kept, self._token):
            return "wrong tokens", _refuse(_OLD_LINK, 403)
        return None, None

    def _is_known(self, host: str) -> bool:
        match = _HOST.fullmatch(host)
        if not match:
            return False
        name = match["name"].lower()
        try:
            address = ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return name in self._names
        return self._token is not None or address.is_loopback

    @staticmethod
    def _token_of_link(scope: Scope) -> str | None:
        return QueryParams(scope["query_string"]).get("token") if scope["path"] == "/" else None

    def _token_of_cookie(self, headers: Headers) -> str | None:
        cookie = SimpleCookie()
        try:
            cookie.load(headers.get("cookie", ""))
        except CookieError:
            return None
        return cookie[self._cookie].value if self._cookie in cookie else None

    def _admit(self) -> Response:
        # A redirect would be part of the navigation to the link: where that began on a page of another site, such
        # as a chat, browsers send no cookie that is SameSite=Strict. A refresh begins here.
        response = HTMLResponse(_DOCUMENT.format(""), headers={"Refresh": "0; url=/"})
        response.set_cookie(self._cookie, self._token or "", httponly=True, samesite="strict", path="/")
        return response

    def _count_status(self, status: int) -> None:
        if status == 404:
            self._refusals.add("unknown addresses")
        elif status == 405:
            self._refusals.add("wrong methods")


def _is_token(given: str, token: str) -> bool:
    """In a time that does not depend on how many characters are right."""
    return secrets.compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())


def _refuse(text: str, status: int) -> Response:
    return HTMLResponse(_DOCUMENT.format(f"<h1>{text}</h1>"), status, {"Connection": "close"})


def _add_headers(headers: MutableHeaders, host: str, *, is_local: bool) -> None:
    """Own files only: no script in the page, no other site, no frame around it, no copy that stays."""
    # Safari before 15.4 does not count websockets as 'self'.
    sockets = f" ws://{host}" if host else ""
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
        f" connect-src 'self'{sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    headers.setdefault("Content-Security-Policy", policy)
    headers["X-Content-Type-Options"] = "nosniff"
    headers["X-Frame-Options"] = "DENY"
    headers["Referrer-Policy"] = "no-referrer"
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
    headers["Cache-Control"] = "no-store"
    if is_local:
        # Browsers heed it for https and their own machine; from others it is an error in their console.
        headers["Cross-Origin-Opener-Policy"] = "same-origin"
