"""Packages and their folders: who may import whom, who touches the disk and the console, what each package offers."""

import ast
import importlib
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAY_IMPORT = {
    "refract": set(),
    "geo": set(),
    "evaluation": set(),
    "fields": {"refract", "evaluation"},
    "survey": {"refract", "geo", "evaluation", "fields"},
    "bathynerf": {"refract", "geo", "evaluation", "fields", "survey"},
}
# Lines of each package, which may only become fewer.
MOST_LINES = {
    "bathynerf": 140, "evaluation": 1259, "fields": 13_003, "geo": 4455, "refract": 2698, "survey": 48_011,
}  # fmt: skip
# Folders by layer, the lowest first: a folder imports only folders of the layers below its own, within what its package
# may import at all.
LAYERS = (
    {"refract", "geo"},
    {"fields"},
    {"fields/sweep/kernels", "refract/curved"},
    {"evaluation", "fields/sweep", "fields/volume", "fields/waves", "survey"},
    {"fields/colour", "fields/occluded", "fields/solver", "survey/files", "survey/display"},
    {"survey/photos", "survey/compare", "survey/settings"},
    {"survey/control", "survey/pose_files", "survey/water"},
    {"survey/sfm"},
    {"survey/folder"},
    {"survey/plan", "survey/init"},
    {"survey/adjust/block"},
    {"survey/adjust/result"},
    {"survey/adjust"},
    {"survey/report"},
    {"survey/run"},
    {"survey/export"},
    {"survey/simulate", "survey/change", "survey/marking", "survey/volume"},
    {"survey/handles"},
    {"survey/viewer"},
    {"survey/commands"},
    {"bathynerf"},
)
# What every part of survey uses stands in its folder itself, and nothing else; twelve files at most.
SURVEY_SHARED = {"__init__.py", "errors.py", "machine.py", "progress.py", "stage_key.py", "words.py"}
MOST_SHARED = 12
OUTSIDE = {"tests", "benchmarks", "docs"}
CONSOLE_FOLDER, CONSOLE_FILES = "survey/commands", {"survey/progress.py", "bathynerf/__main__.py"}
CONSOLE = {"print", "input", "sys.exit", "exit", "quit", "typer.echo", "Console"}
DISK = (
    {"open", ".open", ".read_text", ".read_bytes", ".write_text", ".write_bytes", "write_whole"}
    | {".unlink", ".mkdir", ".rmdir", ".rename", ".touch"}
    | {".exists", ".is_file", ".is_dir", ".is_symlink", ".stat", ".lstat", ".iterdir", ".glob", ".rglob"}
    # Not `.replace` of a path: texts and dates have one too.
    | {".symlink_to", ".hardlink_to", ".chmod", "os.access", "os.open", "os.replace", "os.fsync"}
    | {f"{module}.{verb}" for module in ("np", "torch") for verb in ("save", "load", "savez", "savetxt", "loadtxt")}
    | {f"shutil.{verb}" for verb in ("copy", "copyfile", "copytree", "disk_usage", "move", "rmtree")}
    | {"cv2.imread", "cv2.imwrite", "laspy.read", "trimesh.load_scene", "pye57.E57"}
    | {"tempfile.mkdtemp", "tempfile.TemporaryDirectory"}
)
# Folders whose files may touch the disk: formats, inputs, runs and products. All others compute: there a function reads
# and writes only under a path that it is given.
DISK_FOLDERS = (
    {"geo", "survey"}
    | {f"survey/{name}" for name in ("commands", "control", "files", "folder", "init", "marking", "photos")}
    | {f"survey/{name}" for name in ("export", "handles", "pose_files", "run", "sfm", "water")}
    | {"survey/simulate", "survey/viewer", "survey/volume"}
)
GIVEN_PATHS = {"Path", "RunDir"}
# These read what is installed on the machine: libLLVM, foreign packages, the list of public names.
SEARCHES = {"fields/device.py", "bathynerf/_packages.py", "bathynerf/__init__.py"}
# The files that import a module by a name that they put together, which no other test here can follow.
IMPORT_BY_NAME_FILES = {"bathynerf/__init__.py", "fields/models.py", "geo/files.py", "survey/export/registry.py"}
IMPORT_BY_NAME = {"import_module", ".import_module", "__import__"}
NETWORK = {"socket", "urllib", "http", "requests", "ftplib", "fsspec"}
# Where a user names a URL.
REMOTE = "survey/files/remote.py"
# These listen, or judge what others ask, and call nobody.
SERVERS = {"survey/marking/server.py"}
FILES_OF = {package: sorted((ROOT / package).rglob("*.py")) for package in MAY_IMPORT}
FILES = sorted(path for files in FILES_OF.values() for path in files)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def folder_of(name: str) -> str:
    """The folder of a file by its name, e.g. fields/sweep of fields/sweep/bed.py."""
    return name.rpartition("/")[0]


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@cache
def imported(tree: ast.Module) -> set[str]:
    """Dotted names of all that a file imports, at its head or in functions: of ``from a import b`` a and a.b."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@cache
def called(tree: ast.Module) -> set[str]:
    """Names that a file calls: ``open``, ``print``, and of ``a.b.c()`` the last part with a dot before it."""
    return {name for node in ast.walk(tree) if isinstance(node, ast.Call) for name in names_of(node.func)}


def names_of(function: ast.expr) -> set[str]:
    """The names of a function that is called, as `called` has them."""
    if isinstance(function, ast.Name):
        return {function.id}
    if not isinstance(function, ast.Attribute):
        return set()
    owner = function.value
    return {"." + function.attr} | ({f"{owner.id}.{function.attr}"} if isinstance(owner, ast.Name) else set())


def module_files(files: Iterable[str]) -> dict[str, str]:
    """The file of each module by its dotted name: survey/run/folder.py is survey.run.folder."""
    return {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): name for name in files}


def file_imports(trees: Mapping[str, ast.Module]) -> dict[str, set[str]]:
    """For each file those among them that it imports. ``from a import b`` means a/b.py where there is one, else a."""
    files = module_files(trees)
    found: dict[str, set[str]] = {}
    for name, tree in trees.items():
        modules = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                modules |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                dotted = {f"{node.module}.{alias.name}" for alias in node.names}
                modules |= {module if module in files else node.module for module in dotted}
        found[name] = {files[module] for module in modules & files.keys()} - {name}
    return found


def between_folders(imports: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """For each folder the other folders that its files import."""
    found: dict[str, set[str]] = {}
    for name, others in imports.items():
        found.setdefault(folder_of(name), set()).update(folder_of(other) for other in others)
    return {folder: others - {folder} for folder, others in found.items()}


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """The groups of two nodes or more that reach each other (strongly connected components, R. Tarjan 1972)."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    open_nodes: list[str] = []
    found = []

    def visit(node: str) -> None:
        number[node] = lowest[node] = len(number)
        open_nodes.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in number:
                visit(other)
            if other in open_nodes:
                lowest[node] = min(lowest[node], lowest[other])
        if lowest[node] == number[node]:
            start = open_nodes.index(node)
            group = sorted(open_nodes[start:])
            del open_nodes[start:]
            if len(group) > 1:
                found.append(group)

    for node in sorted(graph):
        if node not in number:
            visit(node)
    return found


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    return file_imports({name_of(path): tree_of(path) for path in FILES})


def test_every_package_is_there():
    for package in MAY_IMPORT:
        assert (ROOT / package / "__init__.py").is_file(), f"{package} has no __init__.py"
    assert len(FILES) >= 200


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_file_imports_only_the_packages_below_its_own(package):
    allowed = MAY_IMPORT[package] | {package}
    wrong = []
    for path in FILES_OF[package]:
        packages = {name.split(".")[0] for name in imported(tree_of(path))} & (MAY_IMPORT.keys() | OUTSIDE)
        wrong += [f"{name_of(path)} imports {other}" for other in sorted(packages - allowed)]
    assert wrong == [], f"{package} may import {sorted(MAY_IMPORT[package])}"


def test_files_do_not_import_each_other_in_a_circle(imports):
    assert circles(imports) == []


def test_folders_do_not_import_each_other_in_a_circle(imports):
    assert circles(between_folders(imports)) == []


@pytest.mark.parametrize("package", MOST_LINES)
def test_a_package_only_shrinks(package):
    """A feature takes out as much as it adds; who takes out more lowers the bound."""
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in (ROOT / package).rglob("*.py"))
    assert lines <= MOST_LINES[package]


def test_every_folder_has_one_layer():
    folders = {folder_of(name_of(path)) for path in FILES}
    named = [folder for layer in LAYERS for folder in layer]
    assert len(named) == len(set(named))
    assert folders - set(named) == set(), "these folders are in no layer of LAYERS"
    assert set(named) - folders == set(), "LAYERS names folders that do not exist"


def test_a_folder_imports_only_folders_of_the_layers_below_its_own(imports):
    height = {folder: level for level, layer in enumerate(LAYERS) for folder in layer}
    wrong = [
        f"{name} imports {other}"
        for name, others in imports.items()
        for other in sorted(others)
        if folder_of(other) != folder_of(name) and height[folder_of(other)] >= height[folder_of(name)]
    ]
    assert wrong == []


def test_files_and_modules_that_texts_name_exist():
    texts = [*FILES, *ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").glob("*.py")]
    packages = "|".join(sorted({path.relative_to(ROOT).parts[0] for path in FILES}))
    wrong = []
    for text in texts:
        said = text.read_text(encoding="utf-8")
        files = re.findall(rf"(?<![\w/.])(?:{packages}|tests|benchmarks|examples|scripts)/[\w/]+\.py\b", said)
        wrong += [f"{name_of(text)}: {name}" for name in sorted(set(files)) if not (ROOT / name).is_file()]
        modules = sorted(set(re.findall(rf"`((?:{packages})(?:\.\w+)+)`", said)))
        wrong += [f"{name_of(text)}: {name}" for name in modules if not name.endswith((".toml", ".json", ".txt"))
                  and not is_defined(name)]  # fmt: skip
    assert wrong == []


def test_modules_that_the_docstring_of_a_folder_names_are_in_it():
    wrong = []
    for path in (path for path in FILES if path.name == "__init__.py" and path.parent != ROOT / "bathynerf"):
        # Single words in backticks: `crs`, `images/`. A name with a dot is looked for by another test.
        named = re.findall(r"(?<!`)`([a-z]\w*)/?`(?!`)", ast.get_docstring(tree_of(path)) or "")
        there = {item.name.removesuffix(".py") for item in path.parent.iterdir()}
        wrong += [f"{name_of(path)}: {name}" for name in sorted(set(named) - there)]
    assert wrong == []


def test_the_files_to_open_first_have_the_names_that_are_looked_for():
    said = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = said.partition("| wanted | file |")[2].partition("\n\n")[0]
    pairs = re.findall(r"`([\w/]+\.py)` \(`(\w+)`\)", rows)
    assert len(pairs) > 12
    for file, name in pairs:
        paths = [path for path in FILES if name_of(path).endswith(file)]
        assert any(re.search(rf"^(?:def )?{name}\b", path.read_text("utf-8"), re.MULTILINE) for path in paths), file


def is_defined(name: str) -> bool:
    """Whether a dotted name is that of a folder or file of a package, or of something in it."""
    parts = name.split(".")
    for number in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:number])
        file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if number == len(parts) and place.is_dir():
            return True
        if file.is_file():
            rest = parts[number : number + 1]
            stub = file.with_suffix(".pyi")
            said = (stub if stub.is_file() else file).read_text(encoding="utf-8")
            return not rest or re.search(rf"\b{rest[0]}\b", said) is not None
    return False


def test_survey_itself_holds_only_what_all_its_parts_share():
    files = {path.name for path in (ROOT / "survey").glob("*.py")}
    assert files == SURVEY_SHARED, "a new file belongs into one of the folders of survey"
    assert len(files) <= MOST_SHARED


def test_folders_that_compute_touch_the_disk_only_at_paths_that_they_are_given():
    wrong = {name_of(path): sorted(unasked(tree_of(path)) & DISK) for path in FILES}
    wrong = {name: calls for name, calls in wrong.items() if calls and folder_of(name) not in DISK_FOLDERS}
    assert wrong.keys() - SEARCHES == set(), wrong
    assert SEARCHES - wrong.keys() == set(), "SEARCHES names files that do not touch the disk (any more)"
    idle = DISK_FOLDERS - {folder_of(name_of(path)) for path in FILES if called(tree_of(path)) & DISK}
    assert idle == set(), "DISK_FOLDERS names folders whose files do not touch the disk (any more)"


def unasked(tree: ast.Module) -> set[str]:
    """Names called outside functions, and classes, that are given a path; as `called` writes them."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and is_given_a_path(node):
            return
        if isinstance(node, ast.Call):
            found.update(names_of(node.func))
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(tree)
    return found


def is_given_a_path(node: ast.FunctionDef | ast.ClassDef) -> bool:
    """Whether a parameter of a function, or a field or a parameter of ``__init__`` of a class, is a path."""
    if isinstance(node, ast.ClassDef):
        fields = [item.annotation for item in node.body if isinstance(item, ast.AnnAssign)]
        makers = [item for item in node.body if isinstance(item, ast.FunctionDef) and item.name == "__init__"]
        return any(names_a_path(field) for field in fields) or any(is_given_a_path(maker) for maker in makers)
    parameters = node.args
    given = [*parameters.posonlyargs, *parameters.args, *parameters.kwonlyargs]
    return any(names_a_path(parameter.annotation) for parameter in given)


def names_a_path(annotation: ast.expr | None) -> bool:
    return annotation is not None and bool(GIVEN_PATHS & set(re.findall(r"\w+", ast.unparse(annotation))))


def test_a_call_at_a_path_that_is_not_given_is_seen():
    tree = ast.parse(
        "def f(p: Path): p.open()\ndef g():\n    p.stat()\nclass C:\n    def __init__(self, r: RunDir): r.glob()"
    )
    assert unasked(tree) & DISK == {".stat"}


def test_only_the_files_that_are_named_import_modules_by_name():
    assert {name_of(path) for path in FILES if called(tree_of(path)) & IMPORT_BY_NAME} == IMPORT_BY_NAME_FILES


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_only_commands_and_progress_touch_the_console(package):
    wrong = []
    for path in FILES_OF[package]:
        name, tree = name_of(path), tree_of(path)
        if folder_of(name) == CONSOLE_FOLDER or name in CONSOLE_FILES:
            continue
        found = called(tree) & CONSOLE
        found |= {module for module in imported(tree) if module.split(".")[0] in {"rich", "typer", "click"}}
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Attribute)
                and node.attr in {"stdout", "stderr"}
                and ast.unparse(node.value) == "sys"
            ):
                found.add(f"sys.{node.attr}")
        wrong += [f"{name} uses {other}" for other in sorted(found)]
    assert wrong == [], f"only {CONSOLE_FOLDER} and {CONSOLE_FILES} touch the console"


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_nothing_reaches_for_the_network(package):
    found = {
        name_of(path): imported(tree_of(path)) for path in FILES_OF[package] if name_of(path) not in {REMOTE, *SERVERS}
    }
    wrong = [f"{name} imports {other}" for name, others in found.items() for other in others
             if other.split(".")[0] in NETWORK]  # fmt: skip
    assert wrong == [], "a survey is processed without a network"


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_every_public_name_of_a_package_can_be_imported(package):
    module = importlib.import_module(package)
    names = getattr(module, "__all__", [])
    assert len(names) == len(set(names))
    assert sorted(name for name in names if not hasattr(module, name)) == []


def test_the_walk_sees_what_it_forbids():
    tree = ast.parse("def f():\n    from survey.commands import app\n    p.write_text(open(q))\n    sys.exit(print())")
    assert imported(tree) == {"survey.commands", "survey.commands.app"}
    assert {"open", ".write_text", "sys.exit", "print"} <= called(tree)


def parsed(**files: str) -> dict[str, ast.Module]:
    """Trees of made-up files; ``a__b`` is a/b.py."""
    return {name.replace("__", "/") + ".py": ast.parse(text) for name, text in files.items()}


def test_an_import_of_a_module_is_told_from_one_of_a_name():
    trees = parsed(
        package__part__a="from package.part import b\nfrom package.other.c import name\nimport package.top",
        package__part__b="",
    )
    trees |= parsed(package__other__c="from package.part import b", package__top="") | {
        "package/part/__init__.py": ast.parse("from package.part.a import one"),
        "package/last.py": ast.parse("from package.part import b, one\nimport numpy"),
    }
    found = file_imports(trees)
    assert found["package/part/a.py"] == {"package/part/b.py", "package/other/c.py", "package/top.py"}
    assert found["package/last.py"] == {"package/part/b.py", "package/part/__init__.py"}
    assert between_folders(found)["package/part"] == {"package/other", "package"}


@pytest.mark.parametrize(
    ("graph", "expected"),
    [
        ({"a": {"b"}, "b": {"c"}, "c": set()}, []),
        ({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}, [["a", "b", "c"]]),
        ({"a": {"b"}, "b": {"a", "c"}, "c": {"d"}, "d": {"c"}}, [["c", "d"], ["a", "b"]]),
        ({"a": {"b", "c"}, "b": {"d"}, "c": {"d"}, "d": set()}, []),
    ],
)
def test_circles_are_found_where_there_are_some(graph: dict[str, set[str]], expected: list[list[str]]):
    assert circles(graph) == expected
