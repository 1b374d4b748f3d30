import json,sys,csv
from pathlib import Path
from experiments.gap_drawn import row,is_right
labs={}
for folder in ['../shared/recordings_labs','build/272001','build/272011']:
    for l in json.loads((Path(folder)/'labels.json').read_text()): labs[Path(folder).name,l['case']]=l
rows={}
for f in sorted(Path('build/ablation').glob('*/*.json')):
    d=json.loads(f.read_text()); l=labs[f.parent.name,f.stem]
    if 'error' in d: continue
    for flag,b in d.items(): rows.setdefault(flag,{})[f.parent.name,f.stem]=row(l,{**b,'gains':{}})
names={'no_twins':'healthy twins','lenient':'tolerance of the statistic','chi2':'nuisances where they never are','absorbed':'properties moved by a per cent','needed':'evidence of each cause','needed_feign':'evidence that errors in forms feign','predicting':'held-out trials for each cause','pred_feign':'feigned evidence of random effects','pred_max':'the trial that gains most left out','offform':'forms only as good as usual, held out','inside':'share left where a set acts','between':'scatter between parts','response':'error of forms everywhere','usual':'default tolerance for causes found','shown':'trials quieter than noise','subset':'simpler set not ruled out','small_alike':'small effects are no partners','at_mode':'squares at their best','freed':'groups that an effect frees','openers':'singles opened besides the leading sets','after_first':'effects fitted after the first','together':'effects linearised together','rare':'gaps confined to one place'}
out=[]
for flag,n in names.items():
    ref='base' if flag in('freed','openers','after_first','together','rare') else None
    gained,lost,other,cnt=[],[],0,0; cov=[0,0]; cov0=[0,0]
    for k,r in rows[flag].items():
        b=rows['base'][k]
        if ref is None:
            b=rows['lenient' if flag!='lenient' else 'at_mode'].get(k) or b
            if flag in('lenient','at_mode'): b=rows['chi2'].get(k) or b
        if flag=='no_twins': b=rows['base'][k] if k!=('272011','case_0027') and k!=('272011','case_0019') else b
        cnt+=1
        if is_right(r)!=is_right(b): (gained if is_right(r) else lost).append('+'.join(b['effects']))
        elif (r['outcome'],r['causes'])!=(b['outcome'],b['causes']): other+=1
        cov[0]+=sum(r['covered']);cov[1]+=len(r['covered']);cov0[0]+=sum(b['covered']);cov0[1]+=len(b['covered'])
    out.append((n,cnt,len(lost),', '.join(lost),len(gained),', '.join(gained),f'{cov[0]} of {cov[1]} ({cov0[0]} of {cov0[1]})'))
w=csv.writer(sys.stdout if len(sys.argv)<2 else open(sys.argv[1],'w'))
w.writerow(['without','cases','right verdicts lost','which','gained','which','90 % intervals that hold (with it)'])
for r in out: w.writerow(r)
