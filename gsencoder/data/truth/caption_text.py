"""Captions as the scripts of Scan2Cap compare them."""


def wrapped_caption(text: str) -> str:
    """A caption between sos and eos with full stops as words, as LEO wraps what a language model says; one that begins
    with sos and ends with eos is left as it is.
    """
    words = text.split(" ")
    return text if words[0] == "sos" and words[-1] == "eos" else f"sos {text} eos".replace(". ", " . ")
