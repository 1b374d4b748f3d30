"""Switch special cases of the diagnosis of blocks off one by one: python experiments/ablate.py OUT K/N FOLDER ...

Flags in simgap/abl.py; the search of a case is shared. Some flags ran on a part of the cases only."""
import json,sys,time,os
from pathlib import Path
import numpy as np
from experiments.blind_check.diagnose import read_folder, excluded
from experiments.gap_drawn import row
import simgap.gap.diagnose as D
from simgap.gap.diagnose import *
from simgap.gap.search import search
from simgap.gap.twins import twin_statistics
from hmmseg.jaxconfig import double_precision
from simgap.abl import ON
FULL=['freed','openers','after_first','together']
LATE=['lenient','chi2','absorbed','needed','needed_feign','predicting','pred_feign','pred_max','offform','inside','between','response','usual','shown','subset','small_alike','at_mode','no_twins']
@double_precision
def run(folder, tier):
    aligned, actual = read_folder(folder)
    t=time.process_time()
    found=search(aligned, actual, excluded(folder), ())
    out={}
    memo=[];gen=[None]
    def null(value, flag):
        return
        yield
        k=0
        while True:
            if k<len(memo): yield memo[k]; k+=1; continue
            if gen[0] is None: gen[0]=twin_statistics(found,value,actual,0)
            saved=set(ON); ON.clear()
            try: x=next(gen[0])
            except StopIteration: return
            finally: ON.update(saved)
            memo.append(x)
    def doc(gap, verdict):
        causes=D._causes(found,gap,verdict)
        return D.body(found,verdict,causes,None,0)
    kept={}
    real=D.attribute
    def grab(gap,twins,forced,seed,models=None,absorbed=None):
        kept['base']=(gap,models,absorbed)
        return real(gap,twins,forced,seed,models=models,absorbed=absorbed)
    D.attribute=grab
    for flag in ['base','freed']:
        ON.clear(); ON.update(['alone','singles'] if flag=='openers' else [flag])
        t0=time.process_time()
        gap,v=D.attributed(found,(),0,lambda value: null(value,flag))
        out[flag]={**doc(gap,v),'seconds':time.process_time()-t0}
        if flag=='base': basekept=kept['base']
    D.attribute=real
    gap,models,absorbed=basekept
    import simgap.attribution.attribute as A
    rf,rs,rh=A.forms,A.sought,A.Heldout.of
    f0=rf(gap); m0=rs(f0) if models is None else models
    hk={}
    A.forms=lambda g: f0 if g is gap else rf(g)
    def of(whole, noise, among):
        key=tuple(sorted(set(among)))
        if key not in hk: hk[key]=rh(whole,noise,key)
        return hk[key]
    A.Heldout.of=of
    models=m0
    for flag in LATE:
        ON.clear(); ON.update(['alone','singles'] if flag=='openers' else [flag])
        t0=time.process_time()
        v=real(gap,lambda value: null(value,flag),(),0,models=models,absorbed=absorbed)
        out[flag]={**doc(gap,v),'seconds':time.process_time()-t0}
    A.forms,A.sought,A.Heldout.of=rf,rs,rh
    ON.clear()
    out['base']['twins']=memo
    return out
def main():
    dest=Path(sys.argv[1]); k,n=map(int,sys.argv[2].split('/'))
    cases=[]
    for folder in map(Path,sys.argv[3:]):
        for l in json.loads((folder/'labels.json').read_text()):
            if (folder/l['case']/'rig.toml').exists(): cases.append((folder,l))
    cases.sort(key=lambda c: ('pair','outside','single','healthy').index(c[1]['tier']))
    for folder,l in cases[k::n]:
        f=dest/folder.name/f"{l['case']}.json"; f.parent.mkdir(parents=True,exist_ok=True)
        if f.exists(): continue
        t=time.process_time()
        try: out=run(folder/l['case'], l['tier'])
        except Exception as e:
            import traceback; traceback.print_exc()
            out={'error':repr(e)}
        f.write_text(json.dumps(out))
        print(folder.name,l['case'],l['effects'],out.get('base',{}).get('causes'),round(time.process_time()-t,1),flush=True)
main()
