"""Settings files."""

import pytest

from epipole.io.settings_file import read_settings, settings_text
from epipole.schemas.errors import SettingsError
from epipole.schemas.settings import Settings


def test_changed_settings_are_printed_and_read_back(tmp_path):
    changed = Settings.model_validate(
        {"sensors": {"centroid_sigma_px": 0.25}, "positions": {"reject_sigma": 1e-7}}
    )
    (tmp_path / "s.toml").write_text(settings_text(changed))
    assert read_settings(tmp_path / "s.toml") == changed


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "9" * 5000,
        "x = " + "[" * 3000 + "]" * 3000,
        "[tracklets]\nmax_missed = " + "9" * 4000,
        "[tracklets]\nmax_rate_deg_s = " + "9" * 4000,
    ],
    ids=["digits", "brackets", "integer", "number"],
)
def test_absurd_text_is_one_short_line(text, tmp_path):
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(SettingsError) as raised:
        read_settings(tmp_path / "settings.toml")
    assert str(raised.value).startswith(str(tmp_path / "settings.toml"))
    assert len(str(raised.value)) < 400
