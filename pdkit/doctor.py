"""`pdkit doctor`: what works on this machine, and the fix beside each thing that does not.

Everything that can crash (simulators, graphics drivers) is tried in a process of its own, so a segmentation fault
there is a line here. FAIL is kept for what the main job needs; it works without pictures, so those are warnings.
"""
from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from .errors import PdkitError
from .files import DATA, ROOT, read_json, runs_root, sha256, write_json
from .machine import MUJOCO_DRAWS, SAPIEN_DRAWS, cores, cpu_has_bf16

REINSTALL = "run ./pd doctor, or pip install -r environment.txt"
TIMEOUT = 60  # seconds a probe may take; a busy machine is slow, a hung driver never ends


@dataclass(frozen=True)
class Check:
    """One line: OK, WARN (something is lost, the main job works), FAIL (it does not), or -- (absent, not needed)."""

    status: str
    name: str
    text: str
    fix: str = ""


def probe(code: str, environment: dict[str, str] | None = None) -> tuple[bool, str]:
    """Run Python `code` in a process of its own: whether it ended well, and the last line that it wrote."""
    try:
        done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True,
                              timeout=TIMEOUT, env={**os.environ, **(environment or {})})
    except subprocess.TimeoutExpired:
        return False, f"no answer within {TIMEOUT} s"
    output = (done.stdout if done.returncode == 0 else done.stderr).strip()
    last = output.splitlines()[-1] if output else ""
    if done.returncode < 0:
        return False, f"crashed with signal {-done.returncode}" + (f" ({last[:100]})" if last else "")
    return done.returncode == 0, last if done.returncode == 0 else last[:100] or f"exit code {done.returncode}"


# ---- packages and data -----------------------------------------------------------------------------------------------

def check_python() -> list[Check]:
    """The version of Python."""
    text = f"{platform.python_version()} in {sys.prefix}"
    if sys.version_info[:2] in ((3, 11), (3, 12)):
        return [Check("OK", "python", text)]
    return [Check("FAIL", "python", text, "set PDKIT_PYTHON to a Python 3.11 or 3.12 and remove .venv")]


def check_packages(environment: Path | None = None) -> list[Check]:
    """Every pinned package against environment.txt; a line for each that differs."""
    path = environment or ROOT / "environment.txt"
    try:
        lines = [line.split("#")[0].strip() for line in path.read_text().splitlines()]
    except OSError:
        return [Check("FAIL", "packages", f"{path} cannot be read", "get the checkout again")]
    pins = dict(line.split("==") for line in lines if "==" in line)
    found = []
    for name, pinned in pins.items():
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            found.append(Check("FAIL", "packages", f"{name} {pinned} is not installed", REINSTALL))
            continue
        if version.split("+")[0] != pinned:  # torch's +cpu and +cu130 builds are the same version
            found.append(Check("WARN", "packages", f"{name} is {version}, tested with {pinned}", REINSTALL))
    return found or [Check("OK", "packages", f"{len(pins)} as pinned in environment.txt")]


def data_files() -> list[Path]:
    """The bundled files that checksums.json covers: demonstrations, checkpoints and recorded results."""
    found = (path for part in ("demos", "checkpoints", "results") for path in (DATA / part).rglob("*"))
    return sorted(path for path in found if path.is_file() and not path.name.startswith("."))


def check_data() -> list[Check]:
    """The bundled files against data/checksums.json."""
    path, fix = DATA / "checksums.json", "get the checkout again (git checkout -- data)"
    try:
        expected = read_json(path)
    except PdkitError as error:
        return [Check("FAIL", "data", str(error).rstrip("."), fix)]
    missing = [name for name in expected if not (DATA / name).is_file()]
    changed = [name for name in expected if name not in missing and sha256(DATA / name) != expected[name]]
    altered = [name for name in changed if not name.startswith("results/")]
    found = [Check("FAIL", "data", f"{what}: {', '.join(names)}", fix)
             for what, names in (("missing", missing), ("altered", altered)) if names]
    if recorded := [name for name in changed if name not in altered]:  # sweeps and reports write there, and that is what they are for
        found.append(Check("WARN", "data", f"other results than the shipped ones: {', '.join(recorded)}",
                           "nothing to do if you recorded them; git diff data/results shows what is new"))
    return found or [Check("OK", "data", f"{len(expected)} files with the right checksum")]


def check_disk() -> list[Check]:
    """Space and permission where runs go."""
    folder = runs_root()
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    free = shutil.disk_usage(existing).free / 1e9
    status = "FAIL" if free < 0.5 else "WARN" if free < 3 else "OK"
    checks = [Check(status, "disk", f"{free:.1f} GB free for {folder}", "" if status == "OK" else
                    "free some space, or set PDKIT_RUNS to a folder on another disk")]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            checks.append(Check("OK", "runs", f"{folder} can be written"))
    except OSError as error:
        checks.append(Check("FAIL", "runs", f"{folder} cannot be written ({error.strerror})",
                            "set PDKIT_RUNS to a folder of yours"))
    return checks


# ---- torch and the simulators ----------------------------------------------------------------------------------------

TORCH = """
import json, time, torch
def rate(dtype):  # GFLOP/s of one core: the best of several short runs, since others may be busy too
    a = torch.randn(512, 512, dtype=dtype); best = 1e9
    for _ in range(12):
        start = time.perf_counter(); a @ a; best = min(best, time.perf_counter() - start)
    return 2 * 512**3 / best / 1e9
threads = torch.get_num_threads(); torch.set_num_threads(1)
print(json.dumps({"version": torch.__version__, "threads": threads, "float32": rate(torch.float32),
    "bfloat16": rate(torch.bfloat16), "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else ""}))
"""


def check_torch() -> list[Check]:
    """torch's device, its threads against the cores this process may use, and whether bfloat16 is fast."""
    good, text = probe(TORCH)
    if not good:
        return [Check("FAIL", "torch", text, REINSTALL)]
    seen = json.loads(text)
    device = seen["cuda"] or "the CPU (no CUDA device; none is needed)"
    checks = [Check("OK", "torch", f"{seen['version']} on {device}")]
    text = f"{seen['threads']} threads, {cores()} cores"
    fix = f"set OMP_NUM_THREADS={cores()}: more threads than cores is many times slower"
    checks.append(Check("WARN", "threads", text, fix) if seen["threads"] > cores() else Check("OK", "threads", text))
    ratio, flag = seen["bfloat16"] / seen["float32"], cpu_has_bf16()
    text = (f"one core: {seen['float32']:.0f} GFLOP/s in float32, {seen['bfloat16']:.0f} in bfloat16 ({ratio:.1f}x); "
            f"the CPU says {'yes' if flag else 'no'}")
    if ratio > 1.2 or not flag:
        checks.append(Check("OK" if ratio > 1.2 else "--", "bfloat16", text))
    else:
        checks.append(Check("WARN", "bfloat16", text, "the machine may be busy; else train with bf16 off"))
    return checks


DOOR = """
import gymnasium, gymnasium_robotics
gymnasium.register_envs(gymnasium_robotics)
env = gymnasium.make("AdroitHandDoor-v1"); env.reset(seed=0); env.step(env.action_space.sample())
import mujoco; print("MuJoCo", mujoco.__version__, "steps Adroit Door")
"""
STACK = "import mani_skill.envs, sapien; print('SAPIEN', sapien.__version__, 'and ManiSkill load')"


def check_simulators() -> list[Check]:
    """Whether the simulators load and step at all."""
    good, text = probe(DOOR)
    door = Check("OK", "adroit", text) if good else Check("FAIL", "adroit", text, REINSTALL)
    good, text = probe(STACK)
    fix = REINSTALL
    if "cannot open shared object" in text:
        fix = "sudo apt-get install -y libgl1 libegl1 libglib2.0-0"
    elif sys.platform == "darwin":
        fix = "the Adroit tasks do not need it"
    return [door, Check("OK", "maniskill", text) if good else Check("WARN", "maniskill", text, fix)]


# ---- pictures --------------------------------------------------------------------------------------------------------

def check_mujoco_pictures() -> list[Check]:
    """Each way in which MuJoCo can draw, tried; one is enough."""
    mac = sys.platform == "darwin"
    backends = ("cgl", "glfw") if mac else ("egl", "osmesa", "glfw")
    results = {backend: probe(MUJOCO_DRAWS, {"MUJOCO_GL": backend}) for backend in backends}
    if not mac and not results["glfw"][0] and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        results["glfw"] = (False, "no display")
    fixes = {"egl": "sudo apt-get install -y libegl1 libgl1", "osmesa": "sudo apt-get install -y libosmesa6"}
    works = [backend for backend, (good, _) in results.items() if good]
    checks = []
    for backend, (good, text) in results.items():
        name = f"mujoco {backend}"
        if good:
            checks.append(Check("OK", name, text))
        elif works:
            checks.append(Check("--", name, f"{text}; not needed, {works[0]} works"))
        else:
            checks.append(Check("WARN", name, text, fixes.get(backend, "needs a display; one way to draw is enough")))
    chosen = os.environ.get("MUJOCO_GL")
    if chosen and works and chosen not in works:
        text = f"is set to {chosen}, which does not work"
        checks.append(Check("WARN", "MUJOCO_GL", text, f"export MUJOCO_GL={works[0]}"))
    return checks


def check_sapien_pictures() -> list[Check]:
    """Whether SAPIEN finds a Vulkan driver that can draw. The tasks themselves run without."""
    good, text = probe(SAPIEN_DRAWS)
    if good:
        return [Check("OK", "sapien vulkan", text)]
    return [Check("WARN", "sapien vulkan", f"{text}; ManiSkill tasks run, without pictures", _vulkan_fix())]


def _vulkan_fix() -> str:
    system = platform.freedesktop_os_release() if sys.platform == "linux" else {}
    if system.get("ID") == "debian" and system.get("VERSION_ID") == "12":  # its own Mesa 22.3 is too old for SAPIEN
        return ("add bookworm-backports to apt's sources, then sudo apt-get install -y -t bookworm-backports "
                "mesa-vulkan-drivers libvulkan1")
    if system:
        return "sudo apt-get install -y mesa-vulkan-drivers libvulkan1 (or the driver of the graphics card)"
    return "use Linux for pictures of the ManiSkill tasks"


def check_ffmpeg() -> list[Check]:
    """The ffmpeg that comes with imageio-ffmpeg, asked to encode a second of nothing."""
    code = ("import imageio_ffmpeg as f, subprocess as s, sys; exe = f.get_ffmpeg_exe(); "
            "s.run([exe, '-v', 'error', '-f', 'lavfi', '-i', 'color=s=64x64:d=1', '-c:v', 'libx264', '-f', 'null',"
            " '-'], check=True); print('ffmpeg', f.get_ffmpeg_version(), 'encodes H.264')")
    good, text = probe(code)
    return [Check("OK", "ffmpeg", text) if good else Check("WARN", "ffmpeg", f"{text}; no videos", REINSTALL)]


# ---- pdkit doctor ----------------------------------------------------------------------------------------------------

CHECKS: tuple[Callable[[], list[Check]], ...] = (
    check_python, check_packages, check_data, check_disk, check_torch, check_simulators,
    check_mujoco_pictures, check_sapien_pictures, check_ffmpeg,
)


def diagnose() -> list[Check]:
    """Every check, two at a time, in the order of CHECKS."""
    with ThreadPoolExecutor(2) as pool:
        return [check for checks in pool.map(lambda function: function(), CHECKS) for check in checks]


def main(argv: list[str]) -> int:
    """`pdkit doctor [--json] [--record-checksums]`; returns 1 when something that the main job needs does not work."""
    from .cli import Parser

    parser = Parser(prog="pdkit doctor", description="Check this machine; the fix stands beside each problem.")
    parser.add_argument("--json", action="store_true", help="print the checks as JSON")
    parser.add_argument("--record-checksums", action="store_true", help="write data/checksums.json anew (after making bundled data)")
    args = parser.parse_args(argv)
    if args.record_checksums:
        write_json(DATA / "checksums.json", {str(path.relative_to(DATA)): sha256(path) for path in data_files()})
    checks = diagnose()
    failed = any(check.status == "FAIL" for check in checks)
    if args.json:
        print(json.dumps({"ok": not failed, "checks": [asdict(check) for check in checks]}, indent=1))
        return int(failed)
    for check in checks:
        print(f"{'[' + check.status + ']':7}{check.name:15} {check.text}")
        if check.fix:
            print(f"{'':22} fix: {check.fix}")
    print("\n" + ("The main job cannot run before each [FAIL] above is fixed." if failed else
                  "Ready for the main job: ./pd run"))
    return int(failed)
