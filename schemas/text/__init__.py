"""Text from outside: how it is shown to people, and TOML that people wrote."""
