"""Models of folders: what is said of those that cannot be read, and the fingerprint of those that can."""

import hashlib
import json
import warnings
from pathlib import Path

import pytest

from gsencoder.core import pretrained as model_files
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.pretrained import ANY, digest_files, load_pretrained


@pytest.fixture
def bert(tmp_path: Path) -> Path:
    import transformers

    sizes = {"hidden_size": 8, "intermediate_size": 8, "num_attention_heads": 1, "vocab_size": 5}
    transformers.BertForSequenceClassification(transformers.BertConfig(**sizes, num_hidden_layers=2)).save_pretrained(
        tmp_path
    )
    return tmp_path


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"num_hidden_layers": 1}, "16 belong to layers that the configuration does not have"),
        ({"num_hidden_layers": 3}, "16 are missing"),
        ({"intermediate_size": 9}, "6 have other shapes than the configuration says"),
    ],
)
def test_weights_are_those_of_the_configuration_or_refused(bert: Path, settings: dict[str, int], problem: str) -> None:
    import transformers

    path = bert / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | settings))
    with pytest.raises(
        InputError, match=rf"the weights do not fit the configuration: {problem} \(bert\.encoder\.layer\."
    ):
        load_pretrained(transformers.BertForSequenceClassification, bert, "a test")


@pytest.mark.parametrize("ignored", [(), ("classifier",), ANY])
def test_weights_of_other_parts_are_left_out_with_a_warning_unless_they_are_expected(bert, ignored):
    import transformers

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = load_pretrained(transformers.BertModel, bert, "a test", ignored=ignored)
    assert not model.training
    messages = [str(each.message) for each in caught if each.category is SceneWarning]
    assert len(messages) == (ignored == ())
    assert all("weights that are no part of the backbone are not used: classifier" in each for each in messages)


def test_the_fingerprint_is_that_of_settings_and_files_in_their_order(tmp_path, monkeypatch):
    first, second = tmp_path / "first", tmp_path / "second"
    first.write_bytes(b"0123456789")
    second.write_bytes(b"abc")
    monkeypatch.setattr(model_files, "BLOCK_BYTES", 4)
    assert digest_files(first, second) == hashlib.sha256(b"0123456789abc").hexdigest()[:16]
    assert digest_files(second, first) == hashlib.sha256(b"abc0123456789").hexdigest()[:16]
    assert digest_files(first, settings=("é", 1)) == hashlib.sha256("('é', 1)0123456789".encode()).hexdigest()[:16]
