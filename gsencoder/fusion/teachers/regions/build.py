"""The `regions` teacher from its settings: masks of regions, and one vector for each (M3 sec. 3.3, LangSplat)."""

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import find_file, read_config
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.fusion.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.fusion.teachers.regions.captioned import CaptionedRegions
from gsencoder.fusion.teachers.regions.captions import Captions, captions_of_objects, read_captions
from gsencoder.fusion.teachers.regions.config import RegionsConfig
from gsencoder.fusion.teachers.regions.crops import CropVectors, ImageTower, OnnxImageTower, TransformersImageTower
from gsencoder.fusion.teachers.regions.masks import FileMasks, InstanceMasks, RegionMasks, scene_path
from gsencoder.fusion.teachers.regions.sam import SamMasks
from gsencoder.fusion.teachers.regions.vectors import MapVectors, PicturedRegions, RegionVectors
from gsencoder.fusion.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.text.vocabulary import OpenVocabulary, Words
from gsencoder.types import Scene

RegionsTeacher = CaptionedRegions | PicturedRegions
CAPTIONS_FILE = "captions.json"


def build_regions(config: RegionsConfig, scene: Scene, words: Words | None) -> RegionsTeacher:
    """The teacher of one scene.

    Args:
        config: settings.
        scene: whose masks and captions are read.
        words: of the space; they embed captions.

    Raises:
        InputError: masks, captions, a model or words are missing or do not fit.
    """
    if config.vector == "captions" and words is None:
        raise InputError(
            "teacher regions: captions need words: give a text tower (text=onnx text.model=FOLDER), or a text table "
            "that has them (teacher.words=)"
        )
    masks = _masks(config, scene)
    if scene.views is None:
        raise InputError("teacher regions: the scene has no views")
    if config.vector == "captions":
        assert words is not None
        captions = _captions(config, scene, masks)
        return CaptionedRegions(scene.views, masks, captions, words, rest=config.rest == "mean")
    vectors = _vectors(config, words)
    if words is not None and words.space.channels != vectors.space.channels:
        raise InputError(
            f"teacher regions: its vectors have {vectors.space.channels} channels and its words "
            f"{words.space.channels} ({words.space.text_encoder}); expected both of one joint model"
        )
    return PicturedRegions(scene.views, masks, vectors, min_area=config.min_area)


def _masks(config: RegionsConfig, scene: Scene) -> RegionMasks:
    if config.masks == "instances":
        return InstanceMasks(scene)
    return SamMasks(config) if config.masks == "sam" else FileMasks(scene, config.folder)


def _captions(config: RegionsConfig, scene: Scene, masks: RegionMasks) -> Captions:
    assert scene.views is not None
    if config.captions:
        return read_captions(scene_path(scene, config.captions, "teacher.captions"), scene.views.names)
    if isinstance(masks, FileMasks):
        path = masks.folder / CAPTIONS_FILE
        if not path.is_file():
            raise InputError(
                f"teacher regions: {path}: no such file; vector=captions needs captions of the labels: give "
                "teacher.captions=, or vector=map or vector=crop"
            )
        return read_captions(path, scene.views.names)
    return captions_of_objects(scene.objects)


def _vectors(config: RegionsConfig, words: Words | None) -> RegionVectors:
    """Vectors from the picture.

    Raises:
        InputError: no model, one that cannot be used, or words that it is not the image side of.
    """
    if not config.model:
        raise InputError(
            f"teacher.model= is missing: the image tower of vector={config.vector}, an .onnx file or "
            "a folder for transformers"
        )
    text_encoder = words.space.text_encoder if words is not None else ""
    if config.vector == "map":
        dense = dense_teacher(config, text_encoder)
        if isinstance(words, OpenVocabulary) and isinstance(dense, TransformersTeacher) and not dense.joint:
            raise InputError(
                f"text=: no words lead into {dense.space.layer} of {dense.space.name}; leave out text=, or give a "
                "text-aligned model (CLIP, SigLIP, SigLIP2) with its head"
            )
        return MapVectors(dense)
    tower: ImageTower
    if config.model.lower().endswith(".onnx"):
        tower = OnnxImageTower(find_file(config.model, "teacher.model"), config.onnx)
    else:
        tower = TransformersImageTower(find_file(config.model, "teacher.model", folder=True), config.device)
    if words is not None and not (tower.joint or config.joint or config.words):
        raise InputError(
            f"text=: the vectors of {tower.name} are taken for those of the text tower if teacher.joint=true says that "
            "both belong to one joint model, such as CLIP; other towers have no words"
        )
    return CropVectors(tower, text_encoder=text_encoder, around=config.around)


def dense_teacher(config: RegionsConfig, text_encoder: str) -> Teacher:
    """The teacher whose maps are averaged over regions.

    Raises:
        InputError: it cannot be used.
    """
    if not config.model.lower().endswith(".onnx"):
        folder = find_file(config.model, "teacher.model", folder=True)
        if read_config(folder, "teacher regions").model_type != "radio":
            return TransformersTeacher(
                TransformersConfig(model=config.model, device=config.device), text_encoder=text_encoder
            )
        return RadioTeacher(RadioConfig(model=config.model, device=config.device), text_encoder=text_encoder)
    options = config.onnx
    return OnnxTeacher(
        OnnxConfig(
            model=config.model,
            input=options.input,
            output=options.output,
            layout=options.layout,
            skip_tokens=options.skip_tokens,
            patch=options.patch,
            size=options.size or OnnxConfig().size,
            scale=options.scale,
            mean=options.mean,
            std=options.std,
            threads=options.threads,
        ),
        text_encoder=text_encoder,
    )
