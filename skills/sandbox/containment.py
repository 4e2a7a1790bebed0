"""The layers that contain a process: what it cannot reach, even if its code is an attacker's.

    own network         network and IPC namespaces without an interface, so that it reaches no host, also not this one
    own files           a mount namespace whose root has the folders of code, read-only, and its temporary files; no
                        process in `/proc`, no home, no database
    own user            not root: as root, another user without groups
    no capabilities     none, and none to be had
    no new privileges   no program gives it the rights of another user
    not dumpable        no process of the same user reads its memory
    file rights         Landlock: it reads code, and writes its temporary files only
    signals             Landlock: it reaches no process and no abstract socket outside; no TCP
    system calls        seccomp: a list of allowed calls (`skills.sandbox.system_calls`)

The layers overlap, so that a fault in one, or a kernel without it, does not open what another still closes. Not every
system offers all of them: containers often have no namespaces, older kernels no Landlock. So `offered` tries them in
forks, each in turn and by attempting what it prevents. The layers that held there must be taken by every process after
it: one that cannot take them ends before it reads anything.

The fork server enters the first five, once, and each of its forks the others. A fork has the layers of the one thread
that forked it.
"""

import ctypes
import errno
import json
import os
import socket
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from skills.sandbox import system_calls

# linux/sched.h, linux/prctl.h, linux/mount.h, linux/landlock.h; the numbers of these calls are those of all processors.
_NEW_NS, _NEW_IPC, _NEW_USER, _NEW_NET = 0x00020000, 0x08000000, 0x10000000, 0x40000000
_SET_DUMPABLE, _GET_DUMPABLE, _DROP_BOUND, _SET_SECCOMP, _SET_NO_NEW, _GET_NO_NEW = 4, 3, 24, 22, 38, 39
_BIND, _RECURSIVE, _PRIVATE, _DETACH = 0x1000, 0x4000, 0x40000, 2
_MOUNT_SETATTR, _READ_ONLY, _NO_SET_ID, _NO_DEVICES, _WHOLE_TREE = 442, 0x1, 0x2, 0x4, 0x8000
_HERE = -100  # AT_FDCWD
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF, _BENEATH, _GET_VERSION = 444, 445, 446, 1, 1
_EXECUTE, _WRITE, _READ, _LIST = 0x1, 0x2, 0x4, 0x8
_CHANGE = 0x10 | 0x20 | 0x80 | 0x100 | 0x2000 | 0x4000  # remove folders and files, make them, rename, truncate
_RIGHTS = {1: 0x1FFF, 2: 0x3FFF, 3: 0x7FFF, 4: 0x7FFF, 5: 0xFFFF}  # by version: all that a ruleset can withhold
_TCP, _SOCKETS_AND_SIGNALS, _SCOPES_SINCE = 0x3, 0x3, 6
_CAPABILITIES_3, _SYS_ADMIN, _CAPABILITIES = 0x20080522, 21, 64

NOBODY = 65534
LIBRARIES = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/lib", "/lib64", "/usr/share/zoneinfo")
FILES = ("/etc/ld.so.cache", "/etc/localtime")
# Libraries choose their loops by the processor, so results would differ without; torch's also need the memory's size.
PROCESSORS, OF_PROC = "/sys/devices/system/cpu", ("/proc/cpuinfo", "/proc/meminfo")
DEVICES = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom")

_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Allowance:
    """What a contained process may reach.

    Attributes:
        folder: Of temporary files; a fork uses a folder of its own in it.
        code: The folders of code, which it may read.
        threads: Whether it may start threads.
        program: The only program that it may start; empty: none.
    """

    folder: str
    code: tuple[str, ...]
    threads: bool = False
    program: str = ""


def code_folders() -> list[str]:
    """Return the folders of the interpreter, of installed packages, and of every package that was imported here.

    Folders on `sys.path` are not among them, because the current folder or a checkout may contain data too.
    """
    paths = sysconfig.get_paths()
    found = [
        *LIBRARIES,
        PROCESSORS,
        *(f"{prefix}/{name}" for prefix in (sys.base_prefix, sys.prefix) for name in ("lib", "lib64")),
    ]
    found += [paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    found += [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    found += [part for part in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if part.startswith("/")]
    if cache := os.environ.get("NUMBA_CACHE_DIR"):  # compiled code
        found.append(str(Path(cache).resolve()))
    for name, module in list(sys.modules.items()):
        if "." not in name and name != "__main__":
            found += [str(Path(one).absolute()) for one in getattr(module, "__path__", ()) if isinstance(one, str)]
    linked = [str(one.resolve()) for folder in set(found) for one in _links(folder)]
    return _outermost([one for one in (*found, *linked) if Path(one).is_dir()])


def _links(folder: str) -> list[Path]:
    """Return the links in one of our packages to folders outside of it."""
    if Path(folder, "__init__.py").exists():
        return [one for one in Path(folder).iterdir() if one.is_symlink() and one.is_dir()]
    return []


def _outermost(folders: Iterable[str]) -> list[str]:
    """Return the folders that are not inside another one, parents first."""
    kept: list[str] = []
    for one in sorted(set(folders)):
        if not any(one.startswith(f"{other}/") for other in kept):
            kept.append(one)
    return kept


# ---- layers of the server ----------------------------------------------------------------------------------------


def _own_network(place: Allowance) -> None:
    _unshare(_NEW_NET | _NEW_IPC)


def _no_network(place: Allowance) -> bool:
    """Return whether even this machine cannot be reached."""
    with socket.socket() as tried:
        tried.settimeout(1.0)
        return tried.connect_ex(("127.0.0.1", 9)) == errno.ENETUNREACH


def _own_files(place: Allowance) -> None:
    """Build a root in memory, show it the folders, and leave the old one."""
    _unshare(_NEW_NS)
    _mount(None, "/", None, _RECURSIVE | _PRIVATE)  # nothing that is mounted here is seen outside
    root = "/proc"  # always there, and never a folder of code
    opened = {file: os.open(file, os.O_PATH) for file in OF_PROC}  # it is about to be covered
    descriptors = os.open("/proc/self/fd", os.O_PATH)
    _mount("tmpfs", root, "tmpfs", _NO_SET_ID | _NO_DEVICES, "mode=755,size=1m")
    for folder in place.code:
        if Path(folder).is_symlink():  # as /lib
            Path(f"{root}{folder}").parent.mkdir(parents=True, exist_ok=True)
            os.symlink(os.readlink(folder), f"{root}{folder}")
    for folder in place.code:
        if not Path(folder).is_symlink():
            _show(folder, f"{root}{folder}", _READ_ONLY | _NO_SET_ID | _NO_DEVICES)
    os.fchdir(descriptors)
    for file in OF_PROC:
        _show(str(opened[file]), f"{root}{file}", _READ_ONLY | _NO_SET_ID | _NO_DEVICES)
    for file in (*FILES, *DEVICES):
        if Path(file).exists():
            _show(file, f"{root}{file}", _NO_SET_ID | (0 if file in DEVICES else _READ_ONLY | _NO_DEVICES))
    _show(place.folder, f"{root}{place.folder}", _NO_SET_ID | _NO_DEVICES)
    for one in (*opened.values(), descriptors):
        os.close(one)
    os.chdir(root)
    _checked(_libc.pivot_root(b".", b"."))
    _checked(_libc.umount2(b".", _DETACH))
    os.chdir("/")
    _set_attributes("/", _READ_ONLY, 0)


def _show(source: str, at: str, attributes: int) -> None:
    """Mount a folder or a file at another place."""
    if Path(source).is_dir():
        Path(at).mkdir(parents=True, exist_ok=True)
    else:
        Path(at).parent.mkdir(parents=True, exist_ok=True)
        Path(at).touch()
    _mount(source, at, None, _BIND | _RECURSIVE)
    _set_attributes(at, attributes, _WHOLE_TREE)


def _only_own_files(place: Allowance) -> bool:
    """Return whether the root has nothing else, and cannot be changed."""
    wanted = {Path(one).parts[1] for one in (*place.code, *OF_PROC, *FILES, *DEVICES, place.folder)}
    return set(os.listdir("/")) <= wanted and not Path("/proc/self").exists() and not _writes("/")


def _own_user(place: Allowance) -> None:
    if os.geteuid() == 0:
        os.chown(place.folder, NOBODY, NOBODY)
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)


def _useful_user(place: Allowance) -> bool:
    """Return whether this is not root, and can read the code and write its temporary files."""
    readable = all(os.access(folder, os.R_OK | os.X_OK) for folder in place.code)
    return readable and os.geteuid() != 0 and os.getegid() != 0 and _writes(place.folder)


def _no_capabilities(place: Allowance) -> None:
    for one in range(_CAPABILITIES):
        _libc.prctl(_DROP_BOUND, one, 0, 0, 0)  # refused where there is none to drop
    _checked(_libc.capset(ctypes.byref((ctypes.c_uint32 * 2)(_CAPABILITIES_3, 0)), (ctypes.c_uint32 * 6)()))


def _none_left(place: Allowance) -> bool:
    return not any(_capabilities()) and _is_refused(lambda: os.setgroups([]))


def _no_new_privileges(place: Allowance) -> None:
    _checked(_libc.prctl(_SET_NO_NEW, 1, 0, 0, 0))


def _has_no_new_privileges(place: Allowance) -> bool:
    return bool(_libc.prctl(_GET_NO_NEW, 0, 0, 0, 0) == 1)


# ---- layers of each fork -----------------------------------------------------------------------------------------


def _not_dumpable(place: Allowance) -> None:
    _checked(_libc.prctl(_SET_DUMPABLE, 0, 0, 0, 0))


def _is_not_dumpable(place: Allowance) -> bool:
    return bool(_libc.prctl(_GET_DUMPABLE, 0, 0, 0, 0) == 0)


def _file_rights(place: Allowance) -> None:
    """Withhold every right on files, but for those that are listed here."""
    rights = _RIGHTS[min(_landlock_version(), max(_RIGHTS))]
    rules = [(folder, _READ | _LIST) for folder in place.code]
    rules += [(file, _READ) for file in (*FILES, *OF_PROC)]
    rules += [(file, _READ | _WRITE) for file in DEVICES]
    rules += [(place.folder, _READ | _LIST | _WRITE | _CHANGE)]
    if place.program:
        rules += [(place.program, _READ | _EXECUTE)]
    ruleset = _ruleset(rights, 0, 0)
    try:
        for path, allowed in rules:
            with suppress(FileNotFoundError, PermissionError):  # it is then simply not allowed
                _allow(ruleset, path, allowed & rights)
        _checked(_libc.syscall(_RESTRICT_SELF, ruleset, 0))
    finally:
        os.close(ruleset)


def _has_file_rights(place: Allowance) -> bool:
    """Return whether a folder that every process may list is closed, and the temporary files can be written."""
    try:
        os.listdir("/")
    except PermissionError:
        return _writes(place.folder) and not _writes(place.code[0])
    return False


def _signals(place: Allowance) -> None:
    if _landlock_version() < _SCOPES_SINCE:
        raise OSError(errno.ENOSYS, "Landlock of this kernel has no scopes")
    ruleset = _ruleset(0, _TCP, _SOCKETS_AND_SIGNALS)
    try:
        _checked(_libc.syscall(_RESTRICT_SELF, ruleset, 0))
    finally:
        os.close(ruleset)


def _sends_no_signals(place: Allowance) -> bool:
    """Return whether the parent, a process of the same user, is out of reach."""
    return _is_refused(lambda: os.kill(os.getppid(), 0))


def _system_calls(place: Allowance) -> None:
    steps = system_calls.filter_of(threads=place.threads, programs=bool(place.program), pid=os.getpid())
    buffer = ctypes.create_string_buffer(steps, len(steps))

    class Program(ctypes.Structure):
        _fields_ = (("count", ctypes.c_ushort), ("steps", ctypes.c_void_p))

    program = Program(len(steps) // 8, ctypes.addressof(buffer))
    _checked(_libc.prctl(_SET_SECCOMP, 2, ctypes.byref(program), 0, 0))


def _has_few_system_calls(place: Allowance) -> bool:
    attempts: tuple[Callable[[], object], ...] = (socket.socket, os.fork, lambda: os.getpgid(1))
    return all(_is_refused(one) for one in attempts)


class Layer(NamedTuple):
    """A layer of containment.

    Attributes:
        needs: What it needs of the system.
        apply: Enters it.
        holds: Attempts what it prevents, and returns whether that was refused.
        of_server: Whether the fork server enters it once, and not each fork.
    """

    needs: str
    apply: Callable[[Allowance], None]
    holds: Callable[[Allowance], bool]
    of_server: bool = False


_LAYERS = {  # in the order in which they are entered
    "own network": Layer(
        "network and IPC namespaces: CAP_SYS_ADMIN, or user namespaces for everybody", _own_network, _no_network, True
    ),
    "own files": Layer("mount namespaces, likewise, and Linux 5.12", _own_files, _only_own_files, True),
    "own user": Layer("code and temporary files that another user than root can reach", _own_user, _useful_user, True),
    "no capabilities": Layer("Linux 2.6.26", _no_capabilities, _none_left, True),
    "no new privileges": Layer("Linux 3.5", _no_new_privileges, _has_no_new_privileges, True),
    "not dumpable": Layer("Linux 2.4", _not_dumpable, _is_not_dumpable),
    "file rights": Layer("Landlock: Linux 5.13", _file_rights, _has_file_rights),
    "signals": Layer("Landlock with scopes: Linux 6.12", _signals, _sends_no_signals),
    "system calls": Layer("seccomp filters, on x86_64 or aarch64", _system_calls, _has_few_system_calls),
}
LAYERS = {name: layer.needs for name, layer in _LAYERS.items()}


def prepare(layers: Iterable[str]) -> None:
    """Enter the user namespace that namespaces need without root, before an import starts a thread, which forbids it.

    Raises:
        OSError: The system refuses it.
    """
    if not {"own network", "own files"}.isdisjoint(layers):
        _own_rights()


def enter(place: Allowance, layers: Iterable[str], *, of_server: bool) -> None:
    """Enter those of the layers that a fork server enters, after `prepare`, or those that each fork enters.

    Other threads of this process do not enter all of them.

    Raises:
        OSError: The system refuses one of them.
    """
    for name, layer in _LAYERS.items():
        if name in layers and layer.of_server == of_server:
            layer.apply(place)


def offered(place: Allowance) -> list[str]:
    """Return the layers that hold on this system, all together.

    They are tried in forks. If one fails, the others are tried again without it, because it may have failed half-way.
    """
    wanted = list(LAYERS)
    while len(held := _held_in_a_fork(place, wanted)) < len(wanted):
        wanted.remove(wanted[len(held)])
    return wanted


def _held_in_a_fork(place: Allowance, wanted: list[str]) -> list[str]:
    """Enter layers in a fork, and return those that held, up to the first that did not."""
    receive, send = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            if _tried(place, wanted, send, of_server=True):
                if os.fork() == 0:  # as later: its parent has the same user, and only the layers of a server
                    _tried(place, wanted, send, of_server=False)
                else:
                    os.wait()
        except BaseException:  # noqa: S110 - whatever it was, the layer does not hold
            pass
        finally:
            os._exit(0)
    os.close(send)
    with open(receive, "rb") as reports:
        held = [json.loads(line) for line in reports]
    os.waitpid(pid, 0)
    if os.geteuid() == 0:
        os.chown(place.folder, 0, 0)  # the fork gave it away
    return held


def _tried(place: Allowance, wanted: list[str], pipe: int, *, of_server: bool) -> bool:
    """Enter layers, write the names of those that hold to a pipe, and return whether all hold."""
    for name in wanted:
        if _LAYERS[name].of_server == of_server:
            _LAYERS[name].apply(place)
            if not _LAYERS[name].holds(place):
                return False
            os.write(pipe, json.dumps(name).encode() + b"\n")
    return True


# ---- calls of the kernel -----------------------------------------------------------------------------------------


def _checked(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def _unshare(flags: int) -> None:
    _own_rights()
    _checked(_libc.unshare(flags))


def _own_rights() -> None:
    """Move into a user namespace in which this process has every capability, unless it may make namespaces already."""
    if not _capabilities()[_SYS_ADMIN // 32] & 1 << _SYS_ADMIN % 32:
        user, group = os.geteuid(), os.getegid()
        _checked(_libc.unshare(_NEW_USER))
        for file, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
            Path("/proc/self", file).write_text(text)


def _capabilities() -> list[int]:
    """Return the effective capabilities, then the others."""
    sets = (ctypes.c_uint32 * 6)()
    _checked(_libc.capget(ctypes.byref((ctypes.c_uint32 * 2)(_CAPABILITIES_3, 0)), sets))
    return [sets[0], sets[3], sets[1], sets[4], sets[2], sets[5]]


def _mount(source: str | None, at: str, kind: str | None, flags: int, options: str | None = None) -> None:
    given = [None if one is None else os.fsencode(one) for one in (source, at, kind)]
    _checked(_libc.mount(*given, ctypes.c_ulong(flags), None if options is None else options.encode()))


def _set_attributes(at: str, attributes: int, flags: int) -> None:
    """Set attributes of a mount, and by flag of those inside it; those that are set already stay."""
    attr = (ctypes.c_uint64 * 4)(attributes)
    _checked(_libc.syscall(_MOUNT_SETATTR, _HERE, os.fsencode(at), flags, attr, ctypes.sizeof(attr)))


def _landlock_version() -> int:
    return _checked(_libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _GET_VERSION))


def _ruleset(files: int, network: int, scopes: int) -> int:
    """Return a set of rules, a file descriptor, that withholds these rights."""
    attr = (ctypes.c_uint64 * 3)(files, network, scopes)
    size = ctypes.sizeof(attr) if network or scopes else 8  # older kernels know the first field only
    return _checked(_libc.syscall(_CREATE_RULESET, attr, ctypes.c_size_t(size), 0))


def _allow(ruleset: int, path: str, rights: int) -> None:
    """Allow rights on a file, or on everything beneath a folder."""

    class Beneath(ctypes.Structure):
        _pack_ = 1
        _fields_ = (("rights", ctypes.c_uint64), ("folder", ctypes.c_int32))

    opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        rule = Beneath(rights if Path(path).is_dir() else rights & (_EXECUTE | _WRITE | _READ | 0x4000), opened)
        _checked(_libc.syscall(_ADD_RULE, ruleset, _BENEATH, ctypes.byref(rule), 0))
    finally:
        os.close(opened)


def _writes(folder: str) -> bool:
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _is_refused(attempt: Callable[[], object]) -> bool:
    try:
        attempt()
    except PermissionError:
        return True
    return False
