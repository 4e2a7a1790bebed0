"""Function calls in subprocesses under resource limits, which contain the effects of untrusted input.

    forked        `ForkServer` calls functions in forks of a small server that has imported everything already, within a
                  millisecond or two; `call_alone` calls one in a new interpreter; `Turns` shares the forks fairly
    fork_server   the server process itself
    limits        the limits, and the errors for processes that return no result

There is one mechanism: a new interpreter is a fork server without imports, for a single call. There is one format: an
input is a file, or a value written by `skills.packing`, and a result is a value written by `skills.packing`, which is
untrusted and validated by the constructors of the few classes that the caller allows. Nothing is unpickled.

Every process gets a minimal environment and a folder for temporary files, has limits on memory, time, open files and
output, is killed with its descendants at the timeout or when its parent dies, and reports its outcome by its exit code.
"""
