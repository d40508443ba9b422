"""`gsencoder views FEATURES query=…`: renders of the views that show best what a word stands for, with their scores."""

from dataclasses import dataclass, field
from pathlib import Path

from gsencoder.app.heads import features_for_heads, heads_of_folder
from gsencoder.app.options import QueriesConfig
from gsencoder.app.run import Run
from gsencoder.app.scenes import load_feature_scene, load_query, query_words
from gsencoder.core.archive import write_archive
from gsencoder.core.budget import MEGABYTE
from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig
from gsencoder.fusion.measured_heads import find_head, head_space, head_tokens
from gsencoder.infer.localize import (
    LocalizeConfig,
    box_to_json,
    describe_absent,
    localize,
    select_features,
    words_to_json,
)
from gsencoder.infer.views.budget import ViewsBudget, check_views_budget, choose_views_within
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.pictures import (
    SHEET,
    Fit,
    describe_view,
    feature_tokens,
    token_blends,
    tower_grid,
    view_pictures,
    views_to_json,
    write_pictures,
)
from gsencoder.infer.views.targets import Target, ViewsConfig, ViewSet, best_boxes, targets_of
from gsencoder.models.output_space import check_heads_space
from gsencoder.render import BlendConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import Box, Scene

VIEWS, TOKENS = "views.json", "tokens.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsCommandConfig(QueriesConfig):
    """Settings of `views`."""

    token_head: str = option(
        "",
        "adapter head that rendered features of grid= are put through, such as siglip.features; empty = that of head=",
    )
    photos: str = option("", "the scene that was fused; its photographs are shown instead of renders")
    boxes: int = option(1, "number of boxes of each word that are shown, best first", ge=1)
    grid: tuple[int, ...] = option(
        (), "rows and columns of the patches of a vision tower, on which features are rendered in addition"
    )
    fit: Fit = option("stretch", "how the preprocessing of the tower fits a picture to its input size")
    choose: ViewsConfig = field(default_factory=ViewsConfig)
    budget: ViewsBudget = field(default_factory=ViewsBudget)
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        QueriesConfig.__post_init__(self)
        check_views_budget(self.budget, self.choose)
        if len(self.grid) not in (0, 2):
            raise InputError(f"grid: expected rows and columns, such as [27,27], got {list(self.grid)}")
        if self.grid:
            tower_grid(1, 1, (self.grid[0], self.grid[1]))
        elif self.token_head:
            raise InputError("token_head: is for rendered features; give grid= as well, or leave it out")


def run(config: ViewsCommandConfig, run: Run) -> None:
    """Localizes the words, chooses and renders views of them, and writes the pictures and their scores."""
    folder = Path(config.paths[0])
    with run.step("load"):
        scene = load_feature_scene(folder, config.photos, config.data)
    boxes: tuple[Box, ...] = ()
    targets: tuple[Target, ...] = ()
    absent: dict[str, str] = {}
    if config.query or config.queries or config.choose.method == "greedy":
        with run.step("localize"):
            words = query_words(config.query, config.queries)
            queried, table = load_query(
                scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text
            )
            localization = localize(queried, words, table, config.localize)
            assert scene.gaussians is not None
            targets = targets_of(scene.gaussians, localization, config.boxes)
        absent = {word: describe_absent(value) for word, value in localization.absent.items()}
        if not targets:
            listing = ", ".join(f"{word!r} is {text}" for word, text in absent.items())
            raise InputError(f"views: none of the words has a box in scene {scene.name}: {listing}")
        boxes = best_boxes(localization, config.boxes)
        run.results.update(boxes=[box_to_json(box) for box in boxes], words=words_to_json(localization))
    budget, choice, pictures, lines = config.budget, None, None, list[str]()
    with run.step("choose"):
        if budget.limits:
            choice = choose_views_within(scene, targets, config.choose, budget)
            views, pictures = choice.views, choice.pictures
        else:
            views = choose_views(scene, targets, config.choose)
    if choice is not None:
        run.report_choice(scene.name, choice.chosen, predicted=choice.predicted, notes=choice.notes)
    out = run.out(scene.name, "views")
    rows = views_to_json(scene, views)
    run.results.update(views=rows, judged=views.judged)
    with run.folder(out) as target:
        with run.step("render"):
            write_pictures(target, scene, views, rows, pictures or view_pictures(scene, views)[0], boxes)
        write_json(target / VIEWS, rows)
        if config.grid:
            with run.step("tokens"):
                write_tokens(target / TOKENS, scene, views, config)
        if choice is not None:
            size = sum((target / row["picture"]).stat().st_size for row in rows)
            measured = {"seconds": choice.seconds, "megabytes": size / MEGABYTE}
            if budget.error is not None and budget.check:
                with run.step("check"):
                    assert scene.gaussians is not None
                    measured["error"] = choice.realised_error(scene.gaussians, targets)
            lines = run.report_budget(budget, measured)
    run.print(*(f"{word}: {text}" for word, text in absent.items()))
    run.print(*(f"{number:2d}  {describe_view(each)}" for number, each in enumerate(views.chosen)))
    run.print(*(f"{out}: {line}" for line in lines))
    run.print(f"{out}: {len(views)} of {views.judged} views, {SHEET}, {VIEWS}" + (f", {TOKENS}" * bool(config.grid)))


def write_tokens(path: Path, scene: Scene, views: ViewSet, config: ViewsCommandConfig) -> None:
    """Writes rendered features as tokens [V, rows · columns, D] float32, under the name "tokens".

    With an adapter head they are outputs of the head for the rendered features of the backbone, as in SplatDistill's
    sec. 3.4: heads are not linear, so rendering the outputs for the Gaussians would give others.
    """
    assert scene.gaussians is not None
    name, option = config.token_head or config.head, "token_head" if config.token_head else "head"
    head = None
    if name:
        heads = heads_of_folder(Path(config.paths[0]), name, option)
        features = features_for_heads(scene, heads, config.space)
        check_heads_space(heads.space, features.space)
        head = find_head(heads, name, option)
        space = head_space(features.space, head)
    else:
        _, features = select_features(scene, config.space or None)
        space = features.space
    grid = (config.grid[0], config.grid[1])
    blends = token_blends(scene.gaussians, views.cameras, grid, fit=config.fit, config=BlendConfig(near=views.near))
    tokens = feature_tokens(blends, features)
    if head is not None:
        tokens = head_tokens(tokens, head)
    header = {"space": space.describe(), "grid": list(grid), "fit": config.fit}
    write_archive(path, {"tokens": tokens.numpy()}, header)
