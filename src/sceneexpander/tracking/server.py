"""Which server runs go to, and whether it is there."""

from __future__ import annotations

import http.client
import ssl
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from dataclasses import replace

from sceneexpander.errors import UserError
from sceneexpander.tracking.config import SERVER_ADDRESSES, TrackingConfig

SHELL_URI = "MLFLOW_TRACKING_URI"
_PATIENCE_S = 10.0
_NOBODY = frozenset({502, 503, 504})  # what a proxy says when the server behind it is not there


def where_runs_go(config: TrackingConfig, environment: Mapping[str, str]) -> TrackingConfig:
    """``config``, or the server that the user's shell names for MLflow where the settings name none.

    Raises:
        UserError: the shell names something that is no server, e.g. a folder.
    """
    named = environment.get(SHELL_URI, "").strip()
    if config.uri != "local" or not named:
        return config
    if not named.startswith(SERVER_ADDRESSES):
        fix = "write http://host:port, or unset it"
        raise UserError(f"is {named!r}, which is no server", where=SHELL_URI, fix=fix)
    return replace(config, uri=named)


def hide_credentials(uri: str) -> str:
    """An address without the name and the password in it."""
    parts = urllib.parse.urlsplit(uri)
    return urllib.parse.urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2])) if parts.netloc else uri


def require_server(config: TrackingConfig) -> None:
    """Raise `UserError` if nobody answers at the address; runs that go to a file, or nowhere, need no server.

    What the server says is left to MLflow's client, which knows its names and passwords. Asking takes no import of MLflow.
    """
    if not config.uri.startswith(SERVER_ADDRESSES):
        return
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE  # the client decides whom it trusts
    try:
        health = f"{hide_credentials(config.uri).rstrip('/')}/health"
        with urllib.request.urlopen(health, timeout=_PATIENCE_S, context=context):  # noqa: S310
            return
    except urllib.error.HTTPError as error:
        if error.code not in _NOBODY:
            return
        problem = f"HTTP {error.code}"
    except urllib.error.URLError as error:
        reason = error.reason
        problem = (reason.strerror if isinstance(reason, OSError) else None) or str(reason)
    except (OSError, ValueError, http.client.HTTPException) as error:
        problem = str(error) or type(error).__name__
    fix = f"start it, or take tracking=none; the address is that of the settings, or of {SHELL_URI}"
    raise UserError(f"does not answer ({problem})", where=f"tracking.uri {hide_credentials(config.uri)}", fix=fix)
