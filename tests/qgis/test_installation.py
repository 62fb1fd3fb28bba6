"""The plugin is copied into a profile, in the place of what was there."""

from pathlib import Path

import pytest

from roadgeo.qgis.installation import install_plugin


@pytest.mark.parametrize("leads", [True, False])
def test_a_link_in_its_place_is_replaced_and_what_it_leads_to_stays(leads: bool, tmp_path: Path) -> None:
    """Who develops the plugin links it there."""
    own, plugins = tmp_path / "own", tmp_path / "profile" / "python" / "plugins"
    own.mkdir()
    (own / "mine.py").touch()
    plugins.mkdir(parents=True)
    (plugins / "roadgeo").symlink_to(own if leads else tmp_path / "gone")
    folder = install_plugin(tmp_path / "profile")
    assert not folder.is_symlink()
    assert (folder / "metadata.txt").is_file()
    assert [path.name for path in own.iterdir()] == ["mine.py"]
