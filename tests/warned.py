"""Calls and their warnings: what they warn of, without any, and none at all."""

import warnings


def told(call, *arguments, **options):
    """What a call gives, and the lines that it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call(*arguments, **options)
    return found, [str(one.message) for one in caught]


def quiet(call, *arguments, **options):
    """What a call gives, whatever it warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call(*arguments, **options)


def without_a_word(call, *arguments, **options):
    """What a call gives that may not warn of anything."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return call(*arguments, **options)
