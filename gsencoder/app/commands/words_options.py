"""Options of the commands that compare words with the features of a folder."""

from dataclasses import dataclass, field

from gsencoder.app.settings.config import CommonConfig


@dataclass(frozen=True, kw_only=True)
class WordsOptions(CommonConfig):
    """Which words are compared with which features. Without slots, as `CommonConfig`."""

    words: str = field(default="", metadata={"help": "text table; empty = the one in the folder of the features"})
    space: str = field(default="", metadata={"help": "name of the feature space, if the folder holds several"})
    head: str = field(
        default="",
        metadata={
            "help": "adapter head whose outputs are compared with the words of text=, such as siglip; empty = the "
            "features themselves are"
        },
    )
