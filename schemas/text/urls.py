"""URLs without their secrets, as they are shown and stored."""

import re

_USER = re.compile(r"(?<=://)[^/?#\n]*@")
# A query or a fragment, with its end in a sentence. A glob such as night-?.mcap is none.
_QUERY = re.compile(r"(://[^\s'\"<>?#]*)[?#]([^\s'\"<>]*=[^\s'\"<>]*|[\w%~+/-]{16,})")
_ENDS = ".,:;)]}"

# Parameters of a query whose values say which file it is. Of all others the values are cut: a
# signature, a token and when they become void have a name of their own in each store.
_PLAIN = {"file", "filename", "path", "name", "version", "versionid"}


def without_secrets(text: str) -> str:
    """Return a text with its URLs as they may be shown: without user, password and signature.

    ``https://me:pw@host/a.mcap?token=x`` becomes ``https://host/a.mcap``. So a URL is the same
    whatever its password is today.
    """
    return _QUERY.sub(_without_values, _USER.sub("", text)) if "://" in text else text


def _without_values(found: re.Match[str]) -> str:
    query = found[2].rstrip(_ENDS)
    pairs = [pair for pair in query.split("&") if pair.partition("=")[0].lower() in _PLAIN]
    return found[1] + ("?" + "&".join(pairs) if pairs else "") + found[2][len(query) :]
