"""Settings files."""

import pytest

from epipole.io.settings_file import merged_settings, read_settings, settings_text
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


def test_settings_that_are_given_count_more_than_the_file_and_the_file_more_than_defaults(tmp_path):
    file = tmp_path / "s.toml"
    file.write_text("[sensors]\ncentroid_sigma_px = 0.25\nstate_gap_s = 7.0\n")
    given = Settings.model_validate({"sensors": {"state_gap_s": 9.0}, "tracklets": {}})
    merged = merged_settings(str(file), given)
    assert (merged.sensors.centroid_sigma_px, merged.sensors.state_gap_s) == (0.25, 9.0)
    assert merged.positions == Settings().positions
    assert merged_settings(None, given) == given
    assert merged_settings(str(file), Settings()) == read_settings(file)
    with pytest.raises(SettingsError, match="No such file"):
        merged_settings(str(tmp_path / "none.toml"), given)
    assert merged_settings(file.as_uri(), given) == merged
    with pytest.raises(SettingsError, match="no such file"):
        merged_settings((tmp_path / "none.toml").as_uri(), given)
