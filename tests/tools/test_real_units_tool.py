"""`tools/real_units`: what it says where there is nothing to learn from."""

import pytest

from ehadiag_tools.accuracy.real_units import main

HEAD = "file,unit,test,Kintas,FSS,FDJ\n"


def test_a_folder_without_the_truth_is_an_error_of_input(tmp_path, capsys):
    assert main(["--recordings", str(tmp_path), "--unit", "A"]) == 3
    assert "truth.csv" in capsys.readouterr().err


def test_a_unit_without_recordings_is_refused(tmp_path, capsys):
    (tmp_path / "truth.csv").write_text(HEAD)
    assert main(["--recordings", str(tmp_path), "--unit", "A"]) == 0
    assert "refused: 0 recording" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--unit", "A"], ["--recordings", "."]])
def test_folder_and_unit_are_asked_for(arguments):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
