"""The address of the service, and whether a key may be sent to it."""

from collections.abc import Mapping
from ipaddress import ip_address

import httpx2 as httpx

from skills.client.problems import UnprotectedKey
from skills.errors import BadSettings
from skills.remedies import Action, Remedy


def service_url(server: str) -> httpx.URL:
    """Return the address of a service.

    Raises:
        BadSettings: It is not an http or https address.
    """
    try:
        url = httpx.URL(server)
    except httpx.InvalidURL:
        url = httpx.URL()
    if url.scheme not in ("http", "https") or not url.host:
        raise BadSettings(
            "The address of the service begins with neither http:// nor https://, or names no host.",
            "Write it as http://127.0.0.1:8000, or https:// and its name.",
        )
    return url


def is_loopback(url: httpx.URL) -> bool:
    """Return whether an address is of this machine; such addresses bypass the proxies of the environment."""
    try:
        return url.host == "localhost" or ip_address(url.host).is_loopback
    except ValueError:
        return False


def key_headers(url: httpx.URL, api_key: str | None, *, plain_http: bool, named: bool) -> Mapping[str, str]:
    """Return the headers that carry the API key; none without one.

    Args:
        url: The address of the service.
        api_key: The key; None: for a service named by its address that of the settings.
        plain_http: Whether the key may be sent where others can read it.
        named: Whether the service was named by its address.

    Raises:
        UnprotectedKey: It would be sent over plain HTTP to another machine.
    """
    if api_key is None and named:
        from skills.settings import settings

        stored = settings().api_key
        api_key = None if stored is None else stored.get_secret_value()
    if not api_key:
        return {}
    if not plain_http and url.scheme != "https" and not is_loopback(url):
        raise UnprotectedKey(
            f"The key would be sent to {url.host} over plain HTTP, where others can read it.",
            Remedy(Action.PROTECT_KEY),
        )
    return {"Authorization": f"Bearer {api_key}"}
