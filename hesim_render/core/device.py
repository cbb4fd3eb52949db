"""Dr.Jit for all modules: ``from hesim_render.core.device import dr``.

It is loaded where a function first uses it, not where a module is imported: it takes an LLVM and looks for GPUs then.
"""

from typing import TYPE_CHECKING, Any

from hesim_render.core.child import interrupts_held


class _OnFirstUse:
    """Dr.Jit's names; each is looked up once."""

    def __getattr__(self, name: str) -> Any:
        with interrupts_held():
            import drjit

        value = getattr(drjit, name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import drjit as dr
else:
    dr = _OnFirstUse()

__all__ = ["dr"]
