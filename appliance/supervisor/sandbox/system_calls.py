"""Calls of the kernel by name: those that no process of ours makes, and those that a listed process may make.

`FORBIDDEN` is refused everywhere: other processes' memory, namespaces, mounts, keys, modules, tracing, and the doors
past a filter (io_uring). `LISTED` is what Python with threads, sockets and SQLite needs: a process that parses what
strangers send gets nothing else.
"""


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


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

LISTED = _names("""
    accept accept4 access alarm arch_prctl brk chdir chmod clock_getres clock_gettime clock_nanosleep close close_range
    copy_file_range dup dup2 dup3 epoll_create epoll_create1 epoll_ctl epoll_ctl_old epoll_pwait epoll_pwait2 epoll_wait
    eventfd eventfd2 exit exit_group faccessat faccessat2 fadvise64 fallocate fchdir fchmod fchmodat fchown fchownat
    fcntl fdatasync flock fstat fstatfs fsync ftruncate futex futex_waitv get_robust_list getcpu getcwd getdents
    getdents64 getegid geteuid getgid getgroups getitimer getpeername getpgid getpgrp getpid getppid getpriority
    getrandom getresgid getresuid getrlimit getrusage getsid getsockname getsockopt gettid gettimeofday getuid ioctl
    kill link linkat listen lseek lstat madvise membarrier memfd_create mincore mkdir mkdirat mlock mremap msync munlock
    munmap nanosleep newfstatat open openat openat2 pause pidfd_open pipe pipe2 poll ppoll prctl pread64 preadv preadv2
    prlimit64 pselect6 pwrite64 pwritev pwritev2 read readahead readlink readlinkat readv recvfrom recvmmsg recvmsg
    rename renameat renameat2 restart_syscall rmdir rseq rt_sigaction rt_sigpending rt_sigprocmask rt_sigqueueinfo
    rt_sigreturn rt_sigsuspend rt_sigtimedwait rt_tgsigqueueinfo sched_get_priority_max sched_get_priority_min
    sched_getaffinity sched_getparam sched_getscheduler sched_setaffinity sched_yield select sendfile sendmmsg sendmsg
    sendto set_robust_list set_tid_address setitimer setpriority setrlimit setsockopt shutdown sigaltstack signalfd
    signalfd4 socketpair splice stat statfs statx symlink symlinkat sync_file_range sysinfo tee tgkill time
    timerfd_create timerfd_gettime timerfd_settime times tkill truncate umask uname unlink unlinkat utime utimensat
    utimes wait4 waitid write writev
""")
