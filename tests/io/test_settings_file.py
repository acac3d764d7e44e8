"""Settings files."""

from epipole.io.settings_file import read_settings, settings_text
from epipole.schemas.settings import Settings


def test_changed_settings_are_printed_and_read_back(tmp_path):
    changed = Settings.model_validate(
        {"sensors": {"centroid_sigma_px": 0.25}, "positions": {"reject_sigma": 1e-7}}
    )
    (tmp_path / "s.toml").write_text(settings_text(changed))
    assert read_settings(tmp_path / "s.toml") == changed
