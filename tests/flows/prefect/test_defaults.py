"""Defaults of the embedded Prefect: quiet and quick, but a user's own settings win."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SETTINGS = """
from prefect.settings import get_current_settings
from epipole.flows.prefect import defaults as prefect_defaults
from epipole.flows.prefect.embedded_server import Served
started = []
served = Served("http://127.0.0.1:1/api", "user:secret")
prefect_defaults.start_server = lambda early: started.append(True) or served
prefect_defaults._check_server = lambda url: None
with prefect_defaults.embedded_prefect():
    server = get_current_settings().server
    print(server.analytics_enabled, server.services.scheduler.enabled,
          server.ephemeral.startup_timeout_seconds, bool(started))
"""


def embedded(home: Path, profile: str = "", **environment: str) -> str:
    """Return the settings that a run has with this profile and environment."""
    if profile:
        (home / "profiles.toml").write_text(f'active = "ours"\n[profiles.ours]\n{profile}\n')
    kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
    ran = subprocess.run(
        [sys.executable, "-c", SETTINGS], env=kept | {"PREFECT_HOME": str(home)} | environment,
        capture_output=True, text=True, cwd=home,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.strip()


@pytest.mark.long
@pytest.mark.parametrize(
    ("profile", "environment", "settings"),
    [
        ("", {}, "False False 120 True"),
        ("PREFECT_SERVER_ANALYTICS_ENABLED = true", {}, "True False 120 True"),
        ("", {"PREFECT_SERVER_SERVICES_SCHEDULER_ENABLED": "true"}, "False True 120 True"),
        ("", {"PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "7"}, "False False 7 True"),
        ('PREFECT_API_URL = "http://127.0.0.1:1/api"', {}, "True True 20 False"),
        ("", {"PREFECT_API_URL": "http://127.0.0.1:1/api"}, "True True 20 False"),
    ],
    ids=["none", "profile", "environment", "timeout", "server in profile", "server"],
)
def test_what_a_user_has_set_wins(profile, environment, settings, tmp_path):
    assert embedded(tmp_path, profile, **environment) == settings
