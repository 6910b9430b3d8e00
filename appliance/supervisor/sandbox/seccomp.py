"""Filter the system calls of a process with libseccomp, which knows their numbers on every architecture.

A call outside the allowlist, or a call that hides its arguments (`clone3`), fails with ENOSYS, so that libraries try
an older call. Only calls of another architecture (32 bits) kill a process: a killed relay stops its topics.

Memory is never writable and executable at once, but `mprotect` may make a written page executable, as compiled code
needs.
"""

import ctypes
import errno
import os
from collections.abc import Iterable

from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


# No process of the appliance needs these system calls: access to other processes' memory, namespaces, mounts, keys,
# modules, tracing, and ways around a filter (io_uring).
FORBIDDEN = _names("""
    acct add_key adjtimex bpf chroot clock_adjtime clock_settime create_module delete_module fanotify_init fanotify_mark
    finit_module fsconfig fsmount fsopen fspick get_kernel_syms init_module io_uring_enter io_uring_register
    io_uring_setup ioperm iopl kcmp kexec_file_load kexec_load keyctl lookup_dcookie mount mount_setattr move_mount
    name_to_handle_at nfsservctl open_by_handle_at open_tree perf_event_open pidfd_getfd pivot_root process_madvise
    process_mrelease process_vm_readv process_vm_writev ptrace query_module quotactl quotactl_fd reboot request_key
    sethostname setdomainname setns settimeofday stime swapoff swapon syslog umount umount2 unshare uselib userfaultfd
    ustat vhangup vm86 vm86old
""")

STARTS_PROGRAMS = ("execve", "execveat", "fork", "vfork")

# Python with threads, sockets and SQLite needs these calls. A process that parses untrusted input gets no other calls.
ALLOWED = _names("""
    accept accept4 access alarm arch_prctl brk chdir chmod clock_getres clock_gettime clock_nanosleep close close_range
    copy_file_range dup dup2 dup3 epoll_create epoll_create1 epoll_ctl epoll_ctl_old epoll_pwait epoll_pwait2 epoll_wait
    eventfd eventfd2 exit exit_group faccessat faccessat2 fadvise64 fallocate fchdir fchmod fchmodat fchown fchownat
    fcntl fdatasync flock fstat fstatfs fsync ftruncate futex futex_waitv get_robust_list getcpu getcwd getdents
    getdents64 getegid geteuid getgid getgroups getitimer getpeername getpgid getpgrp getpid getppid getpriority
    getrandom getresgid getresuid getrlimit getrusage getsid getsockname getsockopt gettid gettimeofday getuid ioctl
    kill link linkat listen lseek lstat madvise membarrier memfd_create mincore mkdir mkdirat mlock mremap msync munlock
    munmap nanosleep newfstatat open openat openat2 pause pidfd_open pipe pipe2 poll ppoll prctl pread64 preadv preadv2
    pselect6 pwrite64 pwritev pwritev2 read readahead readlink readlinkat readv recvfrom recvmmsg recvmsg
    rename renameat renameat2 restart_syscall rmdir rseq rt_sigaction rt_sigpending rt_sigprocmask rt_sigqueueinfo
    rt_sigreturn rt_sigsuspend rt_sigtimedwait rt_tgsigqueueinfo sched_get_priority_max sched_get_priority_min
    sched_getaffinity sched_getparam sched_getscheduler sched_yield select sendfile sendmmsg sendmsg
    sendto set_robust_list set_tid_address setitimer setrlimit setsockopt shutdown sigaltstack signalfd
    signalfd4 socketpair splice stat statfs statx symlink symlinkat sync_file_range sysinfo tee tgkill time
    timerfd_create timerfd_gettime timerfd_settime times tkill truncate umask uname unlink unlinkat utime utimensat
    utimes wait4 waitid write writev
""")

# The kernel permits these on every process of the user, such as another relay. The C library gives 0, the caller.
_OWN = ("prlimit64", "sched_setaffinity")

LIBRARY = "libseccomp.so.2"
_ACT_ALLOW, _ACT_ERRNO, _ACT_KILL_PROCESS = 0x7FFF0000, 0x00050000, 0x80000000
_CMP_NE, _CMP_EQ, _CMP_GE, _CMP_MASKED_EQ = 1, 4, 5, 7
_ATTR_ACT_BADARCH, _ATTR_CTL_SSB, _ATTR_CTL_OPTIMIZE = 2, 7, 8  # attributes of a filter
_FAIL_EPERM, _FAIL_ENOSYS = _ACT_ERRNO | errno.EPERM, _ACT_ERRNO | errno.ENOSYS
_FAMILIES = 64  # more than exist
_CLONE_NEW = tuple(1 << bit for bit in (17, 25, 26, 27, 28, 29, 30))  # CLONE_NEW…
_CLONE_THREAD = 0x00010000
_PROT_WRITE_EXEC = 2 | 4
_MAPPING = ("mmap", "mprotect", "pkey_mprotect")  # each with the protection as its third argument
_PERSONALITY_QUERY = 0xFFFFFFFF

Comparison = tuple[int, int, int, int]  # argument, operator, value, second value


class SeccompError(Exception):
    """No filter is in force."""


class _Comparison(ctypes.Structure):
    _fields_ = (
        ("argument", ctypes.c_uint),
        ("operator", ctypes.c_int),
        ("first", ctypes.c_uint64),
        ("second", ctypes.c_uint64),
    )


class _Filter:
    def __init__(self, otherwise: int) -> None:
        try:
            self._library = ctypes.CDLL(LIBRARY, use_errno=True)
        except OSError as error:
            raise SeccompError(f"{LIBRARY} is missing: apt install libseccomp2 ({error})") from error
        self._library.seccomp_init.restype = ctypes.c_void_p
        context = self._library.seccomp_init(ctypes.c_uint32(otherwise))
        if not context:
            raise SeccompError("libseccomp does not support this machine")
        self._context = ctypes.c_void_p(context)
        self._otherwise = otherwise

    def set(self, attribute: int, value: int) -> None:
        """Set an attribute, if libseccomp and the kernel have it; the same calls are denied without it."""
        self._library.seccomp_attr_set(self._context, ctypes.c_int(attribute), ctypes.c_uint32(value))

    def add(self, action: int, names: Iterable[str], *comparisons: Comparison) -> None:
        """Add a rule for each of these calls that the architecture has."""
        if action == self._otherwise:
            return
        compared = (_Comparison * len(comparisons))(*(_Comparison(*comparison) for comparison in comparisons))
        for name in names:
            number = self._library.seccomp_syscall_resolve_name(name.encode())
            if number < 0:
                continue
            result = self._library.seccomp_rule_add_array(
                self._context, ctypes.c_uint32(action), number, len(comparisons), compared
            )
            if result != 0:
                raise SeccompError(f"no rule for {name}: {os.strerror(-result)}")

    def load(self) -> None:
        result = self._library.seccomp_load(self._context)
        self._library.seccomp_release(self._context)
        if result != 0:
            raise SeccompError(f"the kernel rejected the filter: {os.strerror(-result)}")


def load_filter(sandbox: SandboxPlan) -> None:
    """Load the filter, which includes children and needs `no_new_privs`. Raises `SeccompError`."""
    made = _Filter(_FAIL_ENOSYS if sandbox.allowlist else _ACT_ALLOW)
    made.set(_ATTR_ACT_BADARCH, _ACT_KILL_PROCESS)
    made.set(_ATTR_CTL_SSB, 1)
    made.set(_ATTR_CTL_OPTIMIZE, 2)
    made.add(_FAIL_EPERM, FORBIDDEN)
    made.add(_FAIL_ENOSYS, ("clone3",))
    if not sandbox.programs:
        made.add(_FAIL_EPERM, STARTS_PROGRAMS)
    _sockets(made, sandbox)
    _memory(made, sandbox)
    if sandbox.allowlist:
        made.add(_ACT_ALLOW, ALLOWED)
        made.add(_ACT_ALLOW, _OWN, (0, _CMP_EQ, 0, 0))
        threads = _CLONE_THREAD | sum(_CLONE_NEW)
        made.add(_ACT_ALLOW, ("clone",), (0, _CMP_MASKED_EQ, threads, _CLONE_THREAD))
        made.add(_ACT_ALLOW, ("bind",) if sandbox.binds != () else ())
        made.add(_ACT_ALLOW, ("connect",) if sandbox.connects != () else ())
    else:
        for namespace in _CLONE_NEW:
            made.add(_FAIL_EPERM, ("clone",), (0, _CMP_MASKED_EQ, namespace, namespace))
        made.add(_FAIL_EPERM, ("personality",), (0, _CMP_NE, _PERSONALITY_QUERY, 0))
    made.load()


def _sockets(made: _Filter, sandbox: SandboxPlan) -> None:
    for family in sandbox.families if sandbox.allowlist else ():
        made.add(_ACT_ALLOW, ("socket",), (0, _CMP_EQ, family, 0))
    if not sandbox.allowlist:
        for family in set(range(_FAMILIES)) - set(sandbox.families):
            made.add(_FAIL_EPERM, ("socket",), (0, _CMP_EQ, family, 0))
        made.add(_FAIL_EPERM, ("socket",), (0, _CMP_GE, _FAMILIES, 0))


def _memory(made: _Filter, sandbox: SandboxPlan) -> None:
    both = _PROT_WRITE_EXEC
    if not sandbox.allowlist:
        made.add(_FAIL_EPERM, _MAPPING, (2, _CMP_MASKED_EQ, both, both))
    for allowed in (0, 2, 4) if sandbox.allowlist else ():
        made.add(_ACT_ALLOW, _MAPPING, (2, _CMP_MASKED_EQ, both, allowed))
