"""Shows classes that are ``@xreset.files.checks.frozen`` as data classes in the reference, for their signatures."""

import griffe


class Frozen(griffe.Extension):
    def on_class_instance(self, *, cls: griffe.Class, **_):
        for decorator in cls.decorators:
            if getattr(decorator.value, "canonical_path", "") == "xreset.files.checks.frozen":
                keyword = griffe.ExprKeyword("kw_only", "True")
                decorator.value = griffe.ExprCall(
                    griffe.ExprName("dataclasses.dataclass"), [keyword]
                )
