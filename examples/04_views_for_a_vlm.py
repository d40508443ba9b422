"""Chooses the views that show a thing best, and renders them as pictures for a vision-language model.

gsencoder demo out=outputs/demo
gsencoder fuse outputs/demo/room teacher=palette out=features
python examples/04_views_for_a_vlm.py features red
"""

import sys

from PIL import Image

from gsencoder import PaletteConfig, choose_views, load_features, localize, render_image, targets_of, text_table_of


def main(folder: str, word: str) -> None:
    scene = load_features(folder)
    localization = localize(scene, [word], text_table_of(PaletteConfig()))
    if not localization.boxes:
        sys.exit(f"nothing is {word} in this scene")

    # Targets are the Gaussians of the best box; views are scored by how much of them small renders show.
    targets = targets_of(scene.gaussians, localization, 1)
    views = choose_views(scene, targets)
    for number, selected in enumerate(views.chosen):
        visible = ", ".join(f"{score.visible:.0%} of {score.target}" for score in selected.target_scores)
        picture = render_image(scene.gaussians, views.cameras, number)
        Image.fromarray(picture).save(f"view_{number:02d}.png")
        print(f"view_{number:02d}.png: {selected.name}, shows {visible}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
