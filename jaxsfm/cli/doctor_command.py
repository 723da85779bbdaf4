"""The command `jaxsfm doctor`."""


def doctor(*, paths: bool = False) -> int:
    """Check this installation, and print what a report of a fault needs.

    It prints versions, devices, memory, where the weights come from, and what is missing for what.
    Then it matches two small pictures and lets COLMAP verify the matches. This takes about
    ten seconds, and more at the first time: programs are compiled, and the weights are downloaded
    if this machine has none.

    The exit status is 1 if a plain run cannot work. A missing extra is no fault.

    Args:
      paths: Print paths too. They can name you, so look at them before you publish them.
    """
    from jaxsfm.io import interrupt
    from jaxsfm.runs.doctor import findings

    good = True
    for each in findings(paths=paths):
        interrupt.check()
        lines = each.text.split("\n")
        print(f"{each.name:23s} {'' if each.good else 'FAULT: '}{lines[0]}", flush=True)
        for line in lines[1:]:
            print(f"{'':23s} {line}", flush=True)
        good &= each.good
    print(f"{'result':23s} {'a plain run works' if good else 'a plain run does not work'}")
    return 0 if good else 1
