"""Check the import contracts of .importlinter.

Blender loads the project as one package whose parts import one another relatively; import-linter needs that package
under one name, so links in a temporary folder make it `swag_splatting`. typecheck.py does the same for mypy.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output

CI = Path(__file__).resolve().parent
ROOT = CI.parent
PARTS = ("__init__.py", "swag_engine", "swag_blender", "operators")


@contextmanager
def package_folder(parent: str = "") -> Iterator[str]:
    """Make a temporary folder that holds the extension as the package `swag_splatting` in the folder `parent`."""
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder, parent, "swag_splatting")
        package.mkdir(parents=True)
        for name in PARTS:
            (package / name).symlink_to(ROOT / name)
        yield folder


class OnlyContract(Contract):
    """The package `source` imports only `allowed_modules`, the standard library and itself.

    Only direct imports count, deferred ones and those under TYPE_CHECKING too.
    """

    type_name = "only"

    source = fields.ModuleField()
    allowed_modules = fields.ListField(subfield=fields.ModuleField())

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """List the imports that are not allowed as "importer (line) -> imported"."""
        source = self.source.name
        allowed = (source, *(module.name for module in self.allowed_modules))
        wrong = []
        for importer in sorted({source, *graph.find_descendants(source)}):
            for imported in sorted(graph.find_modules_directly_imported_by(importer)):
                within = any(imported == name or imported.startswith(f"{name}.") for name in allowed)
                if not within and imported.partition(".")[0] not in sys.stdlib_module_names:
                    details = graph.get_import_details(importer=importer, imported=imported)
                    wrong += [f"{importer} (line {detail['line_number']}) -> {imported}" for detail in details]
        return ContractCheck(kept=not wrong, metadata={"wrong": wrong})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print the imports that are not allowed."""
        for line in check.metadata["wrong"]:
            output.print_error(f"- {line}")


def main() -> int:
    with package_folder() as folder:
        command = [str(Path(sys.executable).with_name("lint-imports")), "--config", str(ROOT / ".importlinter")]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join((folder, str(CI)))}
        return subprocess.run([*command, "--no-cache"], cwd=folder, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
