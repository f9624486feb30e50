from importlib import import_module


def load_object(place, key):
    m, n = place.split(":")
    return getattr(import_module(m), n)
