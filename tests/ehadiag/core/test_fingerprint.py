"""Hashes of what configuration files say."""

from __future__ import annotations

from pathlib import Path

from ehadiag.core.actuator import default_actuator, load_actuator
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.stored_test import bundled_tests
from firmware_iface.mapping.bus_map import default_map


def test_comments_and_order_do_not_change_it(tmp_path: Path) -> None:
    from importlib import resources

    text = resources.files("ehadiag").joinpath("data/actuator.toml").read_text()
    first, _, rest = text.partition("[servovalve]")
    other = tmp_path / "other.toml"
    name, _, controller = first.partition("[controller]")
    other.write_text(f"# mine\n{name}[servovalve]{rest}\n[controller]{controller}")
    assert fingerprint(load_actuator(other)) == fingerprint(default_actuator())
    other.write_text(text.replace("GAP = 1.7 ", "GAP = 1.8 "))
    assert fingerprint(load_actuator(other)) != fingerprint(default_actuator())


def test_each_content_has_its_own() -> None:
    things = [*bundled_tests().values(), default_actuator(), default_map()]
    hashes = {fingerprint(item) for item in things}
    assert len(hashes) == len(things)
    assert all(len(item) == 64 for item in hashes)
