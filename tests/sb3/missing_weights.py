"""An encoder whose weights cannot be had, for tables that name it."""

from regil_wrappers.encoders.weights import MissingWeightsError

WHY = "encoder 'dinov3': its weights are not here (a folder)"


def without_dinov3(monkeypatch, module):
    """Let a module's `make_encoder` find no weights of dinov3."""
    make_encoder = module.make_encoder

    def made(name):
        if name == "dinov3":
            raise MissingWeightsError(WHY)
        return make_encoder(name)

    monkeypatch.setattr(module, "make_encoder", made)
