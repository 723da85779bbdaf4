"""What Python has on Linux and macOS but not on Windows, and Windows's laws for files.

`behave_like_windows` lets a process obey them. Only our own packages see it: Python's library and
other packages have branches for both systems, and their own tests.
"""

import builtins
import os
import signal
import sys
from pathlib import Path, PureWindowsPath
from types import ModuleType

OURS = ("jaxsfm",)
refused: list[str] = []
"""What this process was refused since `behave_like_windows`, also where it went on without."""
MODULES = frozenset(
    "_posixsubprocess crypt curses fcntl grp nis ossaudiodev posix pty pwd readline resource spwd "
    "syslog termios tty".split()
)
"""Modules of Python's library that Windows lacks."""
_OS = frozenset(
    "chown chroot confstr copy_file_range ctermid eventfd fchdir fchown fdatasync fork forkpty "
    "fpathconf fstatvfs getegid geteuid getgid getgrouplist getgroups getloadavg getpgid getpgrp "
    "getpriority getrandom getresgid getresuid getsid getuid getxattr initgroups killpg lchown "
    "listxattr lockf login_tty major makedev memfd_create minor mkfifo mknod nice openpty pathconf "
    "pidfd_open pipe2 posix_fadvise posix_fallocate posix_openpt posix_spawn posix_spawnp pread "
    "preadv pwrite pwritev readv register_at_fork removexattr sendfile setegid seteuid setgid "
    "setgroups setns setpgid setpriority setregid setresgid setresuid setreuid setsid setuid "
    "setxattr splice statvfs sync sysconf sysconf_names tcgetpgrp tcsetpgrp timerfd_create ttyname "
    "uname unshare wait wait3 wait4 waitid writev".split()
)
_OS_BEGINS = (
    "CLONE_ EFD_ F_ GRND_ MFD_ NGROUPS_ O_ACCMODE O_ASYNC O_CLOEXEC O_DIRECT O_DSYNC O_EXLOCK "
    "O_LARGEFILE O_NDELAY O_NOATIME O_NOCTTY O_NOFOLLOW O_NONBLOCK O_PATH O_RSYNC O_SHLOCK O_SYNC "
    "O_TMPFILE POSIX_ PRIO_ P_ALL P_PGID P_PID RTLD_ RWF_ SCHED_ SF_ ST_ TFD_ WCONTINUED WCORE "
    "WEXIT WIF WNO WSTOP WTERM WUNTRACED XATTR_ plock pthread_ sched_"
)
_SIGNAL = frozenset(
    "SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGIO SIGKILL SIGPIPE SIGPROF SIGQUIT SIGSTOP SIGSYS "
    "SIGTRAP SIGTSTP SIGTTIN SIGTTOU SIGURG SIGUSR1 SIGUSR2 SIGVTALRM SIGWINCH alarm getitimer "
    "pause setitimer siginterrupt sigpending sigtimedwait sigwait sigwaitinfo".split()
)


def windows_lacks(module: str, name: str) -> bool:
    """Whether a name of `os` or `signal` exists on Linux or macOS alone."""
    if module == "os":
        return name in _OS or name.startswith(tuple(_OS_BEGINS.split()))
    return module == "signal" and (name in _SIGNAL or name.startswith("pthread_"))


class _Without(ModuleType):
    """A module without the names that Windows lacks; `sys.platform` is that of Windows."""

    def __init__(self, module: ModuleType) -> None:
        super().__init__(module.__name__)
        self.__dict__["_module"] = module

    def __getattr__(self, name: str):
        module = self.__dict__["_module"]
        if windows_lacks(module.__name__, name):
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        if module is sys and name == "platform":
            return "win32"
        return getattr(module, name)


def _hide_modules() -> None:
    """Imports in our packages fail as on Windows."""
    instead = {m.__name__: _Without(m) for m in (os, signal, sys)}
    real = builtins.__import__

    def imported(name, globals=None, locals=None, fromlist=(), level=0):
        top = name.partition(".")[0]
        if level == 0 and ((globals or {}).get("__name__") or "").partition(".")[0] in OURS:
            if top in MODULES:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
            if top in instead and (name == top or not fromlist):
                return instead[top]
        return real(name, globals, locals, fromlist, level)

    builtins.__import__ = imported


def _open_files() -> set[str]:
    """The files that this process has open or mapped, native code included."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            found.add(os.readlink(f"/proc/self/fd/{number}"))
        except OSError:  # the one of this very listing
            pass
    lines = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    found |= {line.split(maxsplit=5)[5] for line in lines if line.count(" ") > 5 and "/" in line}
    return {path for path in found if os.path.isfile(path)}


def _obey_laws_of_files() -> None:
    """No file that is open is moved, replaced or deleted, nor a folder that holds such a file.

    `os.rename` replaces nothing, and `os.replace` no folder.
    """

    def full(path, dir_fd=None) -> str:
        base = os.getcwd() if dir_fd is None else os.readlink(f"/proc/self/fd/{dir_fd}")
        return os.path.realpath(os.path.join(base, os.fsdecode(path)))

    def check_closed(path: str) -> None:
        for file in _open_files():
            if file == path or file.startswith(path + os.sep):
                refused.append(f"{path}: {file} is open")
                raise PermissionError(13, f"Windows: {file} is open", path)

    def moved(real, replaces: bool):
        def move(source, target, *, src_dir_fd=None, dst_dir_fd=None):
            old, new = full(source, src_dir_fd), full(target, dst_dir_fd)
            check_closed(old)
            if os.path.lexists(new):
                if not replaces:
                    refused.append(f"{new}: renaming replaces nothing")
                    raise FileExistsError(17, "Windows: rename replaces nothing", new)
                if os.path.isdir(new):
                    refused.append(f"{new}: no folder is replaced")
                    raise PermissionError(13, "Windows: no folder is replaced", new)
                check_closed(new)
            real(source, target, src_dir_fd=src_dir_fd, dst_dir_fd=dst_dir_fd)

        return move

    def removed(real):
        def remove(path, *, dir_fd=None):
            check_closed(full(path, dir_fd))
            real(path, dir_fd=dir_fd)

        return remove

    os.rename, os.replace = moved(os.rename, False), moved(os.replace, True)
    os.remove = os.unlink = removed(os.unlink)
    os.rmdir = removed(os.rmdir)


def behave_like_windows() -> None:
    """From now on, this process does what Windows allows. Call it before our packages are imported.

    Only Linux can tell which files are open.
    """
    if any(name.partition(".")[0] in OURS for name in sys.modules):
        raise ValueError("our packages have been imported already")
    _hide_modules()
    _obey_laws_of_files()


_RESERVED = {"CON", "PRN", "AUX", "NUL"} | {f"{n}{k}" for n in ("COM", "LPT") for k in range(10)}


def forbidden_names(folder: Path) -> list[str]:
    """The paths below a folder that Windows cannot have."""

    def bad(name: str) -> bool:
        return (
            any(c in '<>:"/\\|?*' or ord(c) < 32 for c in name)
            or name.endswith((" ", "."))
            or PureWindowsPath(name).stem.partition(".")[0].upper() in _RESERVED
        )

    return sorted(str(path) for path in folder.rglob("*") if bad(path.name))
