"""Commands that several processes of a launcher start: those that share no work refuse, and write nothing."""

import pytest
from command_runs import refusal

from gsencoder.app.main import COMMANDS
from gsencoder.data.synthetic import make_room, write_room

GIVEN = {"ask": ["features", "question=where"], "score": ["answers"], "demo": []}
"""What a command needs to come as far as its start."""


@pytest.fixture
def second_of_three(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"RANK": "1", "WORLD_SIZE": "3", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize("name", [each.name for each in COMMANDS.values() if not each.several])
def test_a_command_without_work_to_share_says_so(name, second_of_three, tmp_path, capsys):
    out = tmp_path / ("out.html" if name == "view" else "out")
    line = refusal(capsys, name, *GIVEN.get(name, ["scene"]), f"out={out}")
    assert line.startswith(f"error: {name}: runs in one process, and this is process 1 of 3")
    assert not out.exists()


def test_one_scene_is_not_for_several_processes(second_of_three, tmp_path, capsys):
    write_room(make_room(0, objects=1, views=2, width=40, height=30), tmp_path / "room")
    line = refusal(capsys, "fuse", str(tmp_path / "room"), "teacher=palette", f"out={tmp_path / 'out'}")
    assert "room: runs in one process, and this is process 1 of 3" in line
    assert "give several scenes, which processes share" in line
    assert not (tmp_path / "out").exists()
