"""Modules that `mutants.py` plants faults in, by group, and the test files that belong to them."""

MODULES = (
    *(
        "geometry",
        "fusion/lift",
        "fusion/basis",
        "fusion/visibility",
        "infer/localize/boxes",
        "infer/localize/relevancy",
    ),
    *("infer/views/utility", "train/losses", "train/samples", "models/grid/serialize", "models/grid/plan"),
    *("data/seeding/depth", "data/readers/transforms_json", "reconstruct/prune"),
)
FOLDERS = {"geometry": ("tests/test_geometry.py", "tests/render", "tests/data")}
CHECKS = ("color_agreement", "depth_agreement", "epipolar", "pose_readings", "readings", "scene_check", "stray_views")
REPAIRS = ("data/check/registration_fit", "data/check/repair_scene", "data/readers/write_transforms")
LAYOUTS = ("registration", "replica", "scannetpp", "seven_scenes", "tum")
FILES = ("layouts", "posed")
PHOTOGRAPHS = ("feature_matches", "from_photographs", "triangulate", "view_pairs")
SCENE_FILES = {
    **{f"data/check/{name}": ("tests/data/check",) for name in CHECKS},
    **dict.fromkeys(REPAIRS, ("tests/data/check", "tests/app/commands/test_inspect_scene.py")),
    **{f"data/readers/{name}": ("tests/data/readers", "tests/data/test_layouts.py") for name in LAYOUTS},
    **{
        f"data/readers/{name}": (
            "tests/data/readers",
            "tests/data/test_layouts.py",
            "tests/data/test_scenes.py",
            "tests/data/test_transforms_json.py",
            "tests/data/test_transforms_refusals.py",
        )
        for name in FILES
    },
    **{f"data/seeding/{name}": ("tests/data/seeding", "tests/data/test_triangulate.py") for name in PHOTOGRAPHS},
    "data/up": ("tests/data/test_up.py",),
    **dict.fromkeys(("data/splat_frame", "fusion/fit"), ("tests/fusion/test_fit.py",)),
    "train/presence": ("tests/train/test_presence.py",),
    "app/runs/scene_queue": ("tests/app/test_scene_queue.py",),
    "types/scene": ("tests/test_types.py",),
}
"""Modules that read, check and seed scenes of others, drawn with `--scenes`, and the tests that belong to them."""
SEGMENTER = ("tests/fusion/test_segmenter.py", "tests/fusion/test_segmenter_settings.py")
TOWERS = ("build", "embedding_cache", "onnx_tower", "open_vocabulary", "towers", "transformers_tower")
SEGMENTERS = ("build", "segmenter", "segmenter_classes", "segmenter_onnx", "segmenter_transformers")
WORD_FILES = {
    **{f"text/{name}": ("tests/text",) for name in TOWERS},
    "core/pretrained": (
        "tests/core/test_pretrained.py",
        "tests/text/test_transformers_tower.py",
        "tests/fusion/test_radio.py",
        *SEGMENTER,
    ),
    **{f"fusion/teachers/{name}": (*SEGMENTER, "tests/fusion/test_teachers.py") for name in SEGMENTERS},
    "fusion/lift": ("tests/fusion/test_lift.py", *SEGMENTER, "tests/fusion/test_fuse.py"),
    "fusion/interior_views": ("tests/fusion/test_interior_views.py",),
    "fusion/orbit_views": ("tests/fusion/test_interior_views.py",),
    "fusion/teacher_maps": ("tests/fusion/test_teacher_maps.py", *SEGMENTER),
    "types/features": ("tests/test_types.py", *SEGMENTER),
    "infer/localize/presence": ("tests/infer/test_presence.py",),
    "infer/localize/threshold": ("tests/infer/test_presence.py", "tests/infer/test_relevancy.py"),
    **{f"reconstruct/{name}": (f"tests/reconstruct/test_{name}.py",) for name in ("exposure_prediction", "budget")},
    "reconstruct/expected_time": ("tests/reconstruct/test_expected_time.py",),
}
"""Modules of words, of cameras in bare splats and of times and exposures, drawn with `--words`, and their tests."""
SCORE_TESTS = {
    "evaluate/scores": {
        "answers": ("answers", "lemmas", "sentences"),
        "dense_captions": ("dense_captions",),
        "instances": ("instance_masks", "instance_matches", "instances"),
        "instance_orders": ("instance_masks", "instance_matches", "instances"),
        "instance_refusals": ("instance_masks", "instance_matches", "instances"),
        "java_metrics": ("java_metrics",),
        "means": ("means",),
        "ngrams": ("ngrams",),
        "recognition": ("recognition",),
        "referring": ("box_overlap", "referring", "referring_kinds"),
        "semantics": ("semantics",),
        "instance_laws": ("instance_masks", "instance_matches", "instances", "recognition", "semantics"),
        "score_laws": ("answers", "box_overlap", "dense_captions", "lemmas", "ngrams", "sentences"),
    },
    "evaluate/files": {
        "answer_predictions": ("answer_predictions",),
        "caption_predictions": ("caption_predictions",),
        "instance_files": ("class_files", "instances", "scan_truth", "scene_folders", "semantics"),
        "json_files": ("recognition", "referring"),
        "class_files": ("class_files", "scan_truth", "scene_folders", "semantics"),
    },
    "evaluate": {
        "picture_truth": ("picture_truth",),
        "picture_laws": ("picture_truth",),
        "result_table": ("result_table",),
        "scripted_answerer": ("answer_sheets", "scripted_answerer"),
        "semantics_protocol": ("class_scores", "labeled_points"),
        "answer_sheets": ("answer_sheets",),
        "class_scores": ("class_scores",),
        "labeled_points": ("labeled_points",),
        "score_reports": ("score_boxes", "score_files", "score_report", "score_texts"),
        "text_reports": ("score_texts",),
    },
    "data/truth": {
        "class_table": ("class_table",),
        "expressions": ("entries", "expression_boxes", "expressions"),
        "label_sets": ("label_sets", "split_files", "write_truth"),
        "made_expressions": ("made_expressions", "made_situations", "write_sqa3d"),
        "made_questions": ("color_names", "english_nouns", "made_questions", "relations", "seen_objects"),
        "mesh_labels": ("mesh_file", "scannet_labels", "scannetpp_labels", "segment_files"),
        "nearest_vertices": ("nearest_vertices",),
        "questions": ("questions",),
        "scene_labels": ("mesh_instances", "mesh_raster", "scene_labels"),
        "entries": ("entries",),
        "expression_boxes": ("expression_boxes",),
        "instance_maps": ("mesh_instances", "mesh_raster", "scene_labels"),
        "mesh_limits": ("mesh_file", "scannet_labels", "scannetpp_labels", "segment_files"),
        "relations": ("english_nouns", "relations"),
        "seen_laws": (
            *("color_names", "made_expressions", "made_questions", "made_situations", "questions", "seen_objects"),
            "write_sqa3d",
        ),
    },
    "infer/ask": {
        "question_sets": ("predictions", "question_sets"),
        "ask_predictions": ("predictions", "question_sets"),
    },
    "train/tuning": dict.fromkeys(("tuning", "tuning_laws"), ("network", "run", "samples", "towers", "vlm")),
    "data": {"prompt_store": ("prompt_store",)},
}
"""Modules of a folder by the test files that they have."""
SCORE_COMMAND = tuple(f"tests/app/commands/test_{name}.py" for name in ("score_limits", "score_scans"))
OTHER_SCORE_TESTS = {
    **{f"evaluate/score_{name}": SCORE_COMMAND for name in ("boxes", "files", "report")},
    "evaluate/score_texts": ("tests/app/commands/test_score_texts.py",),
    **{
        f"data/truth/{name}": ("tests/evaluate/files/test_instance_files.py", "tests/data/truth/test_number_files.py")
        for name in ("checked_files", "number_files")
    },
}


def _score_files() -> dict[str, tuple[str, ...]]:
    files = dict(OTHER_SCORE_TESTS)
    for folder, tests in SCORE_TESTS.items():
        place = {"infer/ask": "infer", "train/tuning": "train"}.get(folder, folder)
        for test, modules in tests.items():
            for module in modules:
                name = f"{folder}/{module}"
                files[name] = (*files.get(name, ()), f"tests/{place}/test_{test}.py")
    return files


SCORE_FILES = _score_files()
"""Modules that read the truth of benchmarks, score, ask and tune, drawn with `--scores`, and the tests they have."""
