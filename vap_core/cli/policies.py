"""Commands that measure policies: measure policy, measure tokens, embeddings."""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import Workers, names, with_bar

app = typer.Typer()


@app.command("policy")
def eval_policy(
    suite: Annotated[str, typer.Option(help="The benchmark that the policy was trained for.")],
    policy: Annotated[
        str, typer.Option(help="mini-pi0, or a checkpoint's folder or hub id.")
    ] = "mini-pi0",
    scenes: Annotated[
        int,
        typer.Option(min=1, help="Scenes of four episodes each, spread over the suite's tasks."),
    ] = 24,
    ways: Annotated[
        str,
        typer.Option(
            help="How the target is named, with commas: tinted, painted, described, plain; "
            "tinted-magenta, tinted-0.3 or tinted-yellow-0.7 force the colour and the opacity."
        ),
    ] = "tinted,painted,described,plain",
    execute: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Actions of each chunk to carry out before the policy is asked again. Default as "
            "the checkpoint says.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    workers: Workers = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A table to add the episodes to, for example data/results/probe.parquet; those of "
            "the same suite, policy and way in it are replaced."
        ),
    ] = None,
) -> None:
    """Measure what a policy can do with generic objects that no film has shown, told by a tint, by
    paint, by words, or not at all.

    Example: python -m vap_core measure policy --suite simpler-bridge --scenes 4
    Example: python -m vap_core measure policy --suite tabletop --ways tinted --execute 10
    Example: python -m vap_core measure policy --suite simpler-bridge --ways tinted,tinted-magenta
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.study import Study
    from vap_core.simulation import suites
    from vap_make.policy.probe import conclude, keep, kept, probe

    tasks = tuple((suite, task.name) for task in suites.suite(suite).tasks)
    study = Study(tasks, ("generic",), policy=policy)
    checkpoint = study.checkpoint(suite)
    if not checkpoint:
        raise BadStudy(
            f"measure policy: {policy!r} has no weights; "
            "take mini-pi0, or a lerobot checkpoint's folder or hub id."
        )
    if out is not None:
        kept(out)  # refused before the work; read again by keep: others may add to it meanwhile
    table = probe(
        checkpoint,
        suite,
        scenes=scenes,
        ways=names(ways),
        execute=execute,
        seed=seed,
        workers=workers,
    )
    print(conclude(table))
    if out is not None:
        keep(table, out)
        print(f"wrote {out}")


@app.command("tokens")
def eval_tokens(
    suite: Annotated[
        list[str] | None, typer.Option(help="A benchmark; repeatable. Default all four.")
    ] = None,
    k: Annotated[
        str, typer.Option("--k", help="Numbers of photos to learn from, with commas.")
    ] = "1,3,5,7",
    epochs: Annotated[
        int,
        typer.Option(min=1, help="Passes over the augmented photos; the soft prompt's own is 20."),
    ] = 20,
    learn_in: Annotated[
        str,
        typer.Option(help="vlm, policy or both: whose weights a token is learned in."),
    ] = "vlm,policy",
    workers: Workers = 1,
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path(
        "data/runs/tokens"
    ),
    publish: Annotated[
        Path | None,
        typer.Option(help="Keep the tables in this folder too, as token_NAME.parquet."),
    ] = None,
) -> None:
    """Learn the token of every personal object from few and from many photos, in the
    vision-language model and in the policies; measure what it recognizes, and which object of
    listed episodes the model chooses by it. Interrupted, it goes on; about a minute and a half a
    token and core.

    Example: python -m vap_core measure tokens --suite simpler-bridge --k 5 --epochs 2
        --out data/runs/few-tokens
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.tokens.report import report
    from vap_core.evaluation.tokens.study import Tokens, run
    from vap_core.evaluation.tokens.study import publish as write_tables
    from vap_core.simulation.suites import BENCHMARKS

    ks = tuple(int(number) for number in names(k) if number.isdecimal() and int(number))
    if len(ks) != len(names(k)) or not ks:
        raise BadStudy(f"measure tokens: --k {k}: give numbers of photos, such as 1,3,5,7.")
    asked = Tokens(tuple(dict.fromkeys(suite or BENCHMARKS)), ks, epochs, tuple(names(learn_in)))
    print(report(run(asked, out, workers=workers)))
    if publish is not None:
        written = ", ".join(map(str, write_tables(out, publish)))
        print(f"wrote {written}")


@app.command()
def embeddings(
    vlm: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of a vision-language model, such as PaliGemma's. Default the shipped one "
            "that each policy grew from."
        ),
    ] = None,
    policies: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of policies that were initialised from it: pi0, pi0.5, mini-pi0. Default "
            "the suites' default policies."
        ),
    ] = None,
    suite: Annotated[
        str,
        typer.Option(
            help="Whose words to compare, too. Default the one in the policy's name, or all."
        ),
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="Keep the rows in this .parquet or .csv file, too.")
    ] = None,
) -> None:
    """Compare the word embeddings of a vision-language model with those of policies: cosine, CKA,
    kNN@1, with the paper's numbers below.

    Example: python -m vap_core measure embeddings
    Example: python -m vap_core measure embeddings models/paligemma-3b-pt-224 models/pi0 models/pi05
    """
    from vap_core.analysis.embedding_report import check_output, keep, report, spaces
    from vap_core.base.errors import BadPolicy
    from vap_core.evaluation.policy_names import shipped
    from vap_core.simulation.suites import BENCHMARKS

    folders = list(policies or ())
    if vlm is None:
        folders = [shipped(name) for name in BENCHMARKS if shipped(name).is_dir()]
    if not folders:
        raise BadPolicy("embeddings: name the folder of a policy after the model's.")
    if out is not None:
        check_output(out)
    table = spaces(vlm, folders, suite, with_bar)
    print(report(table))
    if out is not None:
        keep(table, out)
        print(f"wrote {out}")
