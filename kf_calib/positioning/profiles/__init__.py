"""Profiles of positioners that come with the package, one TOML file each."""
