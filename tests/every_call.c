/* Runs a program and kills it at one of the calls that change a folder or make a file durable:
 *
 *     every_call REPORT N before|after PROGRAM [ARGUMENT ...]
 *
 * Counts all variants of rename, link, unlink, rmdir and fsync that the threads of PROGRAM make, but
 * not those of the processes that PROGRAM starts. Kills PROGRAM with SIGKILL right before or right
 * after call N; with N = 0 it only counts. Returns after PROGRAM and the processes that it started
 * have ended. REPORT receives the number of calls and the name of call N.
 *
 * A seccomp filter stops the program at these calls, however it makes them. A preloaded library
 * would miss calls that bypass the C library, as those of the crate rustix do. */
#include <errno.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

/* Timeout; a program that runs longer is assumed to hang. */
#define MAX_SECONDS 300

static const struct { int number; const char *name; } CALLS[] = {
/* Newer architectures have only the *at variants. */
#ifdef SYS_rename
    {SYS_rename, "rename"}, {SYS_link, "link"}, {SYS_unlink, "unlink"}, {SYS_rmdir, "rmdir"},
#endif
#ifdef SYS_renameat
    {SYS_renameat, "renameat"},
#endif
    {SYS_renameat2, "renameat2"}, {SYS_linkat, "linkat"}, {SYS_unlinkat, "unlinkat"},
    {SYS_fsync, "fsync"}, {SYS_fdatasync, "fdatasync"},
};
enum { CALL_COUNT = sizeof CALLS / sizeof CALLS[0] };

static void fail(const char *what) {
    perror(what);
    exit(70);
}

/* Stops this process and its children at CALLS; the stop's event message is the call's index in CALLS. */
static void install_filter(void) {
    struct sock_filter code[2 * CALL_COUNT + 2];
    struct sock_fprog filter = {0, code};
    code[filter.len++] = (struct sock_filter)BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr));
    for (int i = 0; i < CALL_COUNT; i++) {
        code[filter.len++] = (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, CALLS[i].number, 0, 1);
        code[filter.len++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_TRACE | i);
    }
    code[filter.len++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW);
    if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) || prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &filter)) fail("seccomp");
}

/* Starts the program and traces it with all its children. */
static pid_t start(char **command) {
    int ready[2];
    char byte;
    if (pipe(ready)) fail("pipe");
    pid_t program = fork();
    if (program < 0) fail("fork");
    if (program == 0) {
        close(ready[1]);
        if (read(ready[0], &byte, 1) != 1) exit(70);
        close(ready[0]);
        install_filter();
        execv(command[0], command);
        fail(command[0]);
    }
    long options = PTRACE_O_TRACESECCOMP | PTRACE_O_TRACEFORK | PTRACE_O_TRACEVFORK | PTRACE_O_TRACECLONE |
                   PTRACE_O_TRACESYSGOOD | PTRACE_O_EXITKILL;
    if (ptrace(PTRACE_SEIZE, program, 0, options)) fail("ptrace");
    if (write(ready[1], "x", 1) != 1) fail("pipe");
    close(ready[0]);
    close(ready[1]);
    return program;
}

/* Returns the process that a thread belongs to; 0 if the thread has ended. */
static pid_t process_of(pid_t thread) {
    char path[64], line[256];
    int process = 0;
    snprintf(path, sizeof path, "/proc/%d/status", thread);
    FILE *status = fopen(path, "r");
    while (status && fgets(line, sizeof line, status) && sscanf(line, "Tgid: %d", &process) != 1) {}
    if (status) fclose(status);
    return process;
}

int main(int count, char **words) {
    if (count < 5) return 2;
    const char *report = words[1];
    long target = atol(words[2]), calls = 0;
    int kills_after = !strcmp(words[3], "after"), program_status = 0, status;
    const char *name = "-";
    pid_t program = start(words + 4), thread;
    alarm(MAX_SECONDS);
    while ((thread = waitpid(-1, &status, __WALL)) > 0 || errno == EINTR) {
        if (thread == program && !WIFSTOPPED(status)) program_status = status;
        if (thread <= 0 || !WIFSTOPPED(status)) continue;
        int signal = WSTOPSIG(status), event = status >> 16;
        long resume = PTRACE_CONT;
        if (event == PTRACE_EVENT_SECCOMP && process_of(thread) == program && ++calls == target) {
            unsigned long entry = 0;
            ptrace(PTRACE_GETEVENTMSG, thread, 0, &entry);
            name = CALLS[entry % CALL_COUNT].name;
            if (kills_after) resume = PTRACE_SYSCALL;
            else kill(program, SIGKILL);
        }
        if (signal == (SIGTRAP | 0x80)) kill(program, SIGKILL);
        /* Stops by ptrace itself deliver no signal. An error of ptrace is ignored: the thread may have been killed. */
        int is_signal = event == 0 && signal != (SIGTRAP | 0x80);
        ptrace(resume, thread, 0, is_signal ? signal : 0);
    }
    FILE *out = fopen(report, "w");
    if (!out || fprintf(out, "%ld %s\n", calls, name) < 0 || fclose(out)) fail(report);
    return WIFEXITED(program_status) ? WEXITSTATUS(program_status) : 128 + WTERMSIG(program_status);
}
